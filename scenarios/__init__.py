"""Drives, flights and their parts: what a script runs, and the interfaces of what it can replace."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unifg.models.footprint import Body
    from unifg.models.planar import Base
    from unifg.scenarios.ground.drive_settings import ControllerSettings
    from unifg.scenarios.ground.local_planner import LocalPlanner, PlannerContext, Situation
    from unifg.scenarios.ground.protocols import Estimator, LocaliserContext, World
    from unifg.scenarios.logs.drive_log import EpisodeLog
    from unifg.scenarios.navigation import NavigationSettings, run_navigation
    from unifg.scenarios.perception.readings import Scan

__all__ = [
    "Base",
    "Body",
    "ControllerSettings",
    "EpisodeLog",
    "Estimator",
    "LocalPlanner",
    "LocaliserContext",
    "NavigationSettings",
    "PlannerContext",
    "Scan",
    "Situation",
    "World",
    "run_navigation",
]

_HOMES = {
    "unifg.models.footprint": ("Body",),
    "unifg.models.planar": ("Base",),
    "unifg.scenarios.ground.drive_settings": ("ControllerSettings",),
    "unifg.scenarios.ground.local_planner": ("LocalPlanner", "PlannerContext", "Situation"),
    "unifg.scenarios.logs.drive_log": ("EpisodeLog",),
    "unifg.scenarios.navigation": ("NavigationSettings", "run_navigation"),
    "unifg.scenarios.perception.readings": ("Scan",),
    "unifg.scenarios.ground.protocols": ("Estimator", "LocaliserContext", "World"),
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: help of the command line loads none."""
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__dir__ = __all__.copy
