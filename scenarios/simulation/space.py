"""The ground plane of both worlds: one vehicle's disc among walls and discs, its contacts, and time, by pymunk.

Contacts count only once shapes overlap, so time passes in substeps of 5 ms. The engine moves bodies before it looks for
contacts: a velocity that leads into something touched already must lose that part before a substep begins.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pymunk

from unifg.errors import ScenarioError, require_positive
from unifg.models.footprint import Body
from unifg.typing import Array

__all__ = ["OTHERS", "Mover", "Obstacle", "Policy", "Space", "ToAndFro", "reflected"]

_SUBSTEP = 0.005  # [s]; at 1 m/s a first contact overlaps by at most 5 mm
_EVENT_GAP = 0.5  # [s]; a contact renewed sooner belongs to the same event
_VEHICLE_CATEGORY = 1
_VEHICLE_TYPE, _THING_TYPE = 1, 2

OTHERS = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ _VEHICLE_CATEGORY)
"""Filter of queries that pass the vehicle."""


@dataclass(frozen=True)
class Obstacle:
    """A disc that is not on the map; it rests, or moves to and fro between two points.

    Attributes:
        centre: (2,) where it is at time zero, world frame [m].
        radius: [m].
        end: (2,) far end of the segment it moves along, starting from ``centre`` [m]; None for a fixed
            obstacle.
        speed: speed along the segment [m/s]; 0 for a fixed obstacle.
    """

    centre: Array
    radius: float
    end: Array | None = None
    speed: float = 0.0

    @property
    def moving(self) -> bool:
        """True if the obstacle moves by design, even while it waits."""
        return self.end is not None and self.speed > 0.0

    def positions(self, fractions: Array) -> Array:
        """(n, 2) centres at fractions (n,) of the segment [m]; the same place for a fixed obstacle."""
        end = self.centre if self.end is None else self.end
        return self.centre + fractions[:, None] * (end - self.centre)


class Policy(Protocol):
    """Motion of a mover."""

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        """Velocity for the next substep of ``dt`` [s]."""


class Mover:
    """A disc that rests, or moves by a policy.

    Attributes:
        body: static or kinematic; its position and velocity.
        radius: [m].
        policy: of its motion; None for rest.
        shape: of the body.
    """

    def __init__(self, place: Array, radius: float, policy: Policy | None = None) -> None:
        """Stand at ``place`` (2,) [m]."""
        self.body = pymunk.Body(body_type=pymunk.Body.STATIC if policy is None else pymunk.Body.KINEMATIC)
        self.body.position = (float(place[0]), float(place[1]))
        self.radius, self.policy = radius, policy
        self.shape = pymunk.Circle(self.body, radius)


class Space:
    """One vehicle's disc and what it can run into, each thing with an owner's number.

    Attributes:
        engine: pymunk's space.
        vehicle: body of the vehicle; a wall stops it, it does not turn it.
        body: of the vehicle.
        radius: of its largest disc [m].
        time: since the start [s].
        collisions: contact events so far; contacts with one owner less than 0.5 s apart are one.
    """

    def __init__(self, place: Array, body: Body) -> None:
        """Stand at ``place`` (2,) or (3,), x, y and heading [m, m, rad], alone."""
        self.engine = pymunk.Space()
        self.engine.collision_slop = 1e-4  # the default lets shapes overlap by 0.1 m
        self.engine.collision_bias = 1e-6
        self.vehicle = pymunk.Body(mass=1.0, moment=float("inf"))
        self.vehicle.position = (float(place[0]), float(place[1]))
        self.vehicle.angle = float(place[2]) if len(place) > 2 else 0.0
        self.body, self.radius = body, body.radius
        self.time = 0.0
        self.collisions = 0
        self._owner: dict[pymunk.Shape, int] = {}
        self._discs: list[Mover] = []
        self._touching: dict[int, int] = {}
        self._separated: dict[int, float] = {}

    # ------------------------------------------------------------------ things

    def add(self, shape: pymunk.Shape, owner: int) -> pymunk.Shape:
        """Add a shape on a body of the engine's."""
        shape.collision_type = _THING_TYPE
        shape.filter = pymunk.ShapeFilter(categories=pymunk.ShapeFilter.ALL_MASKS() ^ _VEHICLE_CATEGORY)
        self.engine.add(shape)
        self._owner[shape] = owner
        return shape

    def add_disc(self, obstacle: Obstacle, owner: int) -> pymunk.Shape:
        """Add a disc that rests or goes to and fro."""
        policy = ToAndFro(obstacle) if obstacle.moving else None
        return self.add_mover(Mover(obstacle.centre, obstacle.radius, policy), owner)

    def add_mover(self, mover: Mover, owner: int) -> pymunk.Shape:
        """Add a disc on a body of its own."""
        self._discs.append(mover)
        self.engine.add(mover.body)
        return self.add(mover.shape, owner)

    def add_vehicle(self) -> None:
        """Let the vehicle in, after everything else."""
        shapes: list[pymunk.Shape] = [pymunk.Circle(self.vehicle, r, (x, y)) for x, y, r in self.body.discs]
        if self.body.outline:
            shapes = [pymunk.Poly(self.vehicle, self.body.outline)]
        for shape in shapes:
            shape.collision_type = _VEHICLE_TYPE
            shape.filter = pymunk.ShapeFilter(categories=_VEHICLE_CATEGORY)
        self.engine.add(self.vehicle, *shapes)
        self.engine.on_collision(
            _VEHICLE_TYPE,
            _THING_TYPE,
            begin=lambda met, space, data: self.begin(self._thing(met)),
            separate=lambda met, space, data: self.separate(self._thing(met)),
        )

    def discs(self) -> Array:
        """(K, 4) x, y, radius [m] of the discs now, in the order they were added, and 1 for movers, else 0."""
        rows = [(*disc.body.position, disc.radius, disc.policy is not None) for disc in self._discs]
        return np.array(rows, dtype=np.float64).reshape(-1, 4)

    # -------------------------------------------------------------------- time

    def substeps(self, dt: float) -> Iterator[float]:
        """Lengths [s] of the substeps of ``dt``, the clock set to the end of each.

        Raises:
            ScenarioError: if the duration is not usable.
        """
        require_positive("a step", ScenarioError, duration=dt)
        count, begin = max(1, math.ceil(dt / _SUBSTEP - 1e-9)), self.time
        for k in range(count):
            self.time = begin + (k + 1) * (dt / count)
            yield dt / count

    def advance(self, pause: float) -> None:
        """Move everything for a substep [s]."""
        for disc in self._discs:
            if disc.policy is not None:
                disc.body.velocity = disc.policy.velocity(disc, self, pause)
        self.engine.step(pause)

    def without_contacts(self, velocity: pymunk.Vec2d, relative: bool = True) -> pymunk.Vec2d:
        """A velocity of the vehicle without its parts into things touched, relative to their own motion if asked."""
        contacts: list[tuple[pymunk.Vec2d, float]] = []

        def note(arbiter: pymunk.Arbiter) -> None:
            first, second = arbiter.shapes
            normal, thing = arbiter.contact_point_set.normal, second
            if first in self._owner:
                normal, thing = -normal, first
            assert thing.body is not None
            contacts.append((normal, thing.body.velocity.dot(normal) if relative else 0.0))

        self.vehicle.each_arbiter(note)
        for _ in range(2 if contacts else 0):  # twice, for two things that are not square to one another
            for normal, allowed in contacts:
                velocity -= max(velocity.dot(normal) - allowed, 0.0) * normal
        return velocity

    # ---------------------------------------------------------------- contacts

    def touches(self, owner: int) -> bool:
        """Return True if the vehicle is in contact with an owner's things."""
        return self._touching.get(owner, 0) > 0

    def begin(self, owner: int, counts: bool = True) -> None:
        """Note a contact that begins; one that does not count is no collision."""
        if counts and not self.touches(owner) and self.time - self._separated.get(owner, -math.inf) >= _EVENT_GAP:
            self.collisions += 1
        self._touching[owner] = self._touching.get(owner, 0) + 1

    def separate(self, owner: int) -> None:
        """Note a contact that ends."""
        self._touching[owner] = self._touching.get(owner, 1) - 1
        self._separated[owner] = self.time

    def _thing(self, arbiter: pymunk.Arbiter) -> int:
        first, second = arbiter.shapes
        return self._owner[first] if first in self._owner else self._owner[second]


class ToAndFro:
    """To and fro along the segment of an obstacle at constant speed."""

    def __init__(self, obstacle: Obstacle) -> None:
        """Begin at the obstacle's centre, about to leave for its end."""
        self.origin, end = (pymunk.Vec2d(*place) for place in obstacle.positions(np.array([0.0, 1.0])).tolist())
        span = end - self.origin
        self.length, self.direction, self.speed = span.length, span.normalized(), obstacle.speed
        self.along, self.sense = 0.0, 1.0

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        """Velocity to the next place on the segment, so that nothing drifts."""
        self.along, self.sense = reflected(self.along, self.sense, self.speed * dt, self.length)
        return (self.origin + self.along * self.direction - mover.body.position) / dt


def reflected(along: float, sense: float, step: float, length: float) -> tuple[float, float]:
    """Place [m] and sense after a step [m] to and fro on a way of a length [m], turning round at its ends."""
    along += sense * step
    if 0.0 <= along <= length:
        return along, sense
    return min(max(2.0 * length - along if along > length else -along, 0.0), length), -sense
