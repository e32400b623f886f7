"""Building of the demonstration, shipped as a ROS map; `tools.draw_building` draws it from tables."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from unifg.files.ros_map import OccupancyMap, load_map

__all__ = ["DEMO_GOALS", "DEMO_START", "building_map"]

# A way of about fifty metres: out of the lecture hall, down two corridors, through the laboratory, to the
# lobby.
DEMO_START = (3.0, 25.2, 0.0)
DEMO_GOALS = ((21.5, 8.6, -0.5), (36.6, 18.4, 1.2))


def building_map() -> OccupancyMap:
    """The building floor as shipped: 42 m x 32 m at 0.05 m per cell, named ``building``."""
    return load_map(Path(str(resources.files("unifg.scenarios.simulation").joinpath("building.yaml"))))
