"""Which planner drives, and which localiser says where: those of this library, or others by their short names."""

from __future__ import annotations

import numpy as np

from unifg.errors import ScenarioError
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.rivals.dynamic_window import DynamicWindow
from unifg.scenarios.rivals.elastic_band import ElasticBand
from unifg.scenarios.rivals.local_planner import LocalPlanner
from unifg.scenarios.rivals.path_integral import PathIntegral
from unifg.scenarios.rivals.pure_pursuit import PurePursuit

__all__ = ["OWN_PLANNER", "PLANNERS", "make_planner"]

OWN_PLANNER = "mpc"
PLANNERS = (OWN_PLANNER, "teb", "mppi", "dwa", "pursuit")


def make_planner(
    name: str, distance_map: DistanceMap, settings: ControllerSettings, rng: np.random.Generator
) -> LocalPlanner | None:
    """A planner by its name; None for that of this library.

    Args:
        name: one of ``PLANNERS``.
        distance_map: of the map that the robot was given.
        settings: limits and margins.
        rng: of a planner that draws.

    Raises:
        ScenarioError: for an unknown name.
    """
    common = distance_map, settings
    match name:
        case "mpc":
            return None
        case "teb":
            return ElasticBand(*common)
        case "mppi":
            return PathIntegral(*common, rng)
        case "dwa":
            return DynamicWindow(*common)
        case "pursuit":
            return PurePursuit(*common)
    raise ScenarioError(f"unknown planner '{name}': choose {', '.join(PLANNERS)}")
