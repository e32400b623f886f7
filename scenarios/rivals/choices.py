"""Which planner drives, and which localiser says where: those of this library, or others by their short names."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.rivals.dynamic_window import DynamicWindow
from unifg.scenarios.rivals.elastic_band import ElasticBand
from unifg.scenarios.rivals.local_planner import LocalPlanner
from unifg.scenarios.rivals.monte_carlo import MonteCarlo
from unifg.scenarios.rivals.path_integral import PathIntegral
from unifg.scenarios.rivals.pure_pursuit import PurePursuit
from unifg.typing import Array

__all__ = ["LOCALISERS", "OWN_LOCALISER", "OWN_PLANNER", "PLANNERS", "make_localiser", "make_planner"]

OWN_PLANNER = "mpc"
PLANNERS = (OWN_PLANNER, "teb", "mppi", "dwa", "pursuit")

OWN_LOCALISER = "graph"
LOCALISERS = (OWN_LOCALISER, "amcl")


def make_planner(
    name: str, distance_map: DistanceMap, settings: ControllerSettings, rng: np.random.Generator
) -> LocalPlanner[Any] | None:
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


def make_localiser(
    name: str, occupancy: OccupancyMap, distance_map: DistanceMap, pose: Array, sigma: Array, rng: np.random.Generator
) -> MonteCarlo | None:
    """A localiser by its name; None for that of this library.

    Args:
        name: one of ``LOCALISERS``.
        occupancy: the map that the robot was given.
        distance_map: of it.
        pose: (3,) believed at the start [m, m, rad].
        sigma: (3,) its standard deviations [m, m, rad].
        rng: from which it draws.

    Raises:
        ScenarioError: for an unknown name.
    """
    match name:
        case "graph":
            return None
        case "amcl":
            return MonteCarlo(occupancy, distance_map, pose, sigma, rng)
    raise ScenarioError(f"unknown localiser '{name}': choose {' or '.join(LOCALISERS)}")
