"""Packages that only extras install: what they are for, and how to get one that is missing."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

__all__ = ["PACKAGES", "absent", "remedy"]


class Package(NamedTuple):
    """A package that an extra installs.

    Attributes:
        name: on a package index.
        extra: of unifg.
        purpose: in a few words.
    """

    name: str
    extra: str
    purpose: str


PACKAGES = {
    "matplotlib": Package("matplotlib", "view", "pictures"),
    "meshcat": Package("meshcat", "view", "scenes"),
    "pandas": Package("pandas", "scenarios", "tables of campaigns"),
    "pymunk": Package("pymunk", "scenarios", "simulated worlds"),
    "PIL": Package("pillow", "scenarios", "maps and scenarios"),
    "mcap": Package("mcap", "mcap", "recordings in MCAP"),
    "yaml": Package("pyyaml", "scenarios", "ROS maps"),
    "tqdm": Package("tqdm", "scenarios", "progress bars"),
    "mujoco": Package("mujoco", "mujoco", "worlds of MuJoCo"),
    "casadi": Package("casadi", "casadi", "functions of CasADi"),
    "distributed": Package("distributed", "campaign", "campaigns on clusters"),
}
"""By the names that they are imported by."""


def absent(*extras: str) -> str:
    """Name of the first package of some extras that is not installed, as it is imported; "" without one."""
    return next((name for name, one in PACKAGES.items() if one.extra in extras and find_spec(name) is None), "")


def remedy(missing: str | None) -> str | None:
    """Sentence about a package that is missing, by the name it is imported by; None for one that no extra installs."""
    found = PACKAGES.get((missing or "").partition(".")[0])
    return None if found is None else f"{found.purpose} need {found.name}: pip install 'unifg[{found.extra}]'"
