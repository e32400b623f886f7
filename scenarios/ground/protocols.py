"""Interfaces of what a user can replace in a drive: the world, the localiser, the planner.

Each is a class that `unifg run navigation` takes as MODULE:CLASS, and `NavigationSettings` also as the class.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from unifg.errors import ScenarioError, UnifgError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import Base
from unifg.scenarios.options import find_modules_in
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array, ArrayLike

__all__ = ["Estimator", "Judged", "LocaliserContext", "World", "constructed", "load_class", "name_of", "named"]


class World(Protocol):
    """Truth of a drive: the robot among walls and obstacles, and its sensors.

    A class of a user's own takes the arguments of `unifg.scenarios.simulation.plane.World`, and is most easily derived
    from it.
    """

    time: float
    collisions: int
    lidar: Any

    @property
    def pose(self) -> Array:
        """(3,) true pose of the robot [m, m, rad]."""

    def step(self, *control: float, dt: float) -> None:
        """Apply a control (m,) of the base for ``dt`` [s]."""

    def scan(self) -> Scan:
        """Scan of the present."""

    def odometry(self) -> Sequence[float]:
        """Mean control (m,) over the last step as measured."""

    def power(self, on: bool) -> None:
        """Give the motors power, or cut it."""

    def carry(self, pose: ArrayLike) -> None:
        """Put the robot down at another pose (3,), at rest."""

    def discs(self) -> Array:
        """(K, 4) x, y, radius [m] of obstacles that are not on the map, and 1 for those that move."""

    def clearance(self) -> float:
        """Distance from the hull to the nearest thing [m]."""


class Estimator(Protocol):
    """Localiser of the robot.

    A class of a user's own is constructed with a `LocaliserContext`; ``iterations`` and ``refused`` may be left out.
    """

    @property
    def iterations(self) -> int:
        """Of the last update."""

    @property
    def pose(self) -> Array:
        """(3,) present estimate [m, m, rad]."""

    @property
    def covariance(self) -> Array:
        """(3, 3) of it, in the tangent space."""

    @property
    def refused(self) -> str:
        """Why the last scan has not corrected the estimate, "" where it has."""

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Take in a scan, None for none, and the odometry (m,) since the last one, None on the first."""

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew at a pose (3,), believed with ``sigma`` (3,)."""


class Judged:
    """A user's localiser as the pilot asks it: an answer that is no estimate is refused, and the last one stays.

    Attributes:
        own: the user's object.
        pose: (3,) the last estimate [m, m, rad].
        covariance: (3, 3) of it.
        iterations: of the last update; 0 where the localiser does not say.
        refused: why the last scan has not corrected the estimate; "" where the localiser does not say.
    """

    def __init__(self, own: Estimator) -> None:
        """Take the first estimate.

        Raises:
            ScenarioError: it is none.
        """
        self.own = own
        self._take()

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Update the localiser, and take its estimate.

        Raises:
            ScenarioError: it is none, or the localiser raised something.
        """
        with named("localiser", self.own):
            self.own.update(scan, odometry, dt)
        self._take()

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew, as `Estimator.reset`.

        Raises:
            ScenarioError: the estimate is none, or the localiser raised something.
        """
        with named("localiser", self.own):
            self.own.reset(pose, sigma)
        self._take()

    def _take(self) -> None:
        with named("localiser", self.own):
            said = self.own.pose, self.own.covariance
            pose, covariance = (np.array(part, dtype=np.float64) for part in said)
        right = (pose.shape, covariance.shape) == ((3,), (3, 3)) and np.isfinite([*pose, *covariance.flat]).all()
        if not right or np.linalg.eigvalsh(covariance)[0] <= 0.0:
            what = " and covariance ".join(" ".join(repr(part).split()) for part in said)
            raise ScenarioError(
                f"the localiser says pose {what}: give a finite pose (3,) and a positive definite covariance (3, 3)"
            )
        self.pose, self.covariance = pose, covariance
        self.iterations, self.refused = getattr(self.own, "iterations", 0), getattr(self.own, "refused", "")


@dataclass(frozen=True)
class LocaliserContext:
    """Input of a localiser's construction.

    Attributes:
        occupancy: map that the robot was given.
        distance_map: of it.
        pose: (3,) believed at the start [m, m, rad].
        sigma: (3,) its standard deviations [m, m, rad].
        beams: number of beams in a scan.
        base: that the odometry is of.
        rng: for localisers that sample; decided by the seed of the run.
    """

    occupancy: OccupancyMap
    distance_map: DistanceMap
    pose: Array
    sigma: Array
    beams: int
    base: Base
    rng: np.random.Generator


def name_of(given: str | type) -> str:
    """MODULE:CLASS of a class, or the name itself."""
    return given if isinstance(given, str) else f"{given.__module__}:{given.__qualname__}"


@contextmanager
def named(what: str, own: object) -> Iterator[None]:
    """Name a user's part in what it raises: a robot that drives comes to rest where a part fails, and is recorded.

    Args:
        what: it is.
        own: the user's object.

    Raises:
        ScenarioError: anything was raised, also SystemExit, which is its cause; other errors of unifg stay.
    """
    try:
        yield
    except UnifgError:
        raise
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"the {what} '{name_of(type(own))}' raised {error!r}") from error


def load_class(
    what: str, given: str | type, known: Sequence[str] | Mapping[str, str], methods: Sequence[str], example: str
) -> type:
    """A user's class, or one that ships.

    Args:
        what: it is, for messages.
        given: ``MODULE:CLASS``, or the class; modules of the working directory are found, too.
        known: names that stand for what ships; of a mapping, for the class ``MODULE:CLASS``.
        methods: that it must have, with their arguments.
        example: of such a name.

    Raises:
        ScenarioError: there is no such module or class, or it lacks a method.
        ImportError: what a shipped class needs is not installed.
    """
    if isinstance(known, Mapping) and given in known:
        module_name, _, class_name = known[str(given)].partition(":")
        shipped: type = getattr(import_module(module_name), class_name)
        return shipped
    module_name, colon, class_name = name_of(given).partition(":")
    if not (module_name and colon and class_name):
        choices = " or ".join(map(repr, known))
        raise ScenarioError(f"unknown {what} '{given}': give {choices} or MODULE:CLASS, for example {example}")
    kind: Any = given
    if isinstance(given, str):
        find_modules_in(Path.cwd())
        try:
            module = sys.modules.get(module_name) or import_module(module_name)
        except ImportError as error:
            raise ScenarioError(f"{what} '{given}': cannot import {module_name} from {Path.cwd()}: {error}") from error
        kind = getattr(module, class_name, None)
    if not isinstance(kind, type):
        raise ScenarioError(f"{what} '{given}': {module_name} has no class {class_name}")
    for method in methods:
        if not callable(getattr(kind, method.partition("(")[0], None)):
            raise ScenarioError(f"{what} '{name_of(given)}': {class_name} has no method {method}")
    return kind


def constructed(what: str, kind: type, context: object, attributes: Sequence[str] = ()) -> Any:
    """An object of a user's class.

    Raises:
        ScenarioError: it cannot be constructed with the context, or lacks an attribute.
    """
    try:
        made = kind(context)
    except TypeError as error:
        raise ScenarioError(f"{what} '{name_of(kind)}': {kind.__name__}(context) failed: {error}") from error
    if lacking := [name for name in attributes if not hasattr(made, name)]:
        raise ScenarioError(f"{what} '{name_of(kind)}': {kind.__name__} has no {', '.join(lacking)}")
    return made
