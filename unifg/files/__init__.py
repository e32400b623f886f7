"""File formats: pose graphs, trajectories, logs, maps, bundle adjustment.

Each format is a module of its own; importing one reads nothing else.
"""

from importlib import import_module as _import_module
from types import ModuleType as _ModuleType

__all__ = [
    "bal",
    "carmen",
    "contents",
    "decimals",
    "euroc",
    "g2o",
    "kitti",
    "measured",
    "mrclam",
    "plaza",
    "pose_graph",
    "ros_map",
    "text",
    "toro",
    "tum",
]


def __getattr__(name: str) -> _ModuleType:
    """Import a module of this room when it is first asked for."""
    if name in __all__:
        return _import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


__dir__ = __all__.copy
