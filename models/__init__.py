"""Robots, sensors and what stands in their way, stated as factors: each module is one of them."""

from importlib import import_module as _import_module
from types import ModuleType as _ModuleType

__all__ = [
    "avoidance",
    "barriers",
    "between_nodes",
    "bicycle",
    "bundle_adjustment",
    "cart_pole",
    "clearances",
    "detours",
    "distance_map",
    "inertial",
    "interpolation",
    "keeping",
    "landmarks",
    "lidar",
    "manipulator",
    "matching",
    "obstacles",
    "odometry",
    "planar",
    "potential",
    "preintegration",
    "quadrotor",
    "rkmk",
    "space_landmarks",
    "spline",
    "stamped",
    "tableau",
    "terminal",
    "trajectory",
    "uncertainty",
    "unicycle",
    "vehicle",
]


def __getattr__(name: str) -> _ModuleType:
    """Import a module of this room when it is first asked for."""
    if name in __all__:
        return _import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


__dir__ = __all__.copy
