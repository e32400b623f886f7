"""Sensors of the vehicle: bearing and range of cylinders and corners, height, tilt, body rates, specific force."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import pymunk

from unifg.lie import SO3
from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.readings import NOTHING, Reading
from unifg.typing import Array

__all__ = ["Sensor", "SensorModel"]

First: TypeAlias = Callable[[tuple[float, float], tuple[float, float]], pymunk.Shape | None]
"""First shape that a ray meets between two places [m], None for none."""

_FLANK = 0.9  # of the angle between a cylinder's axis and its silhouette
_FALSE_RADII = (0.1, 0.4)  # [m] of false cylinders
_CORNER_GAP = 0.01  # a ray to a corner ends this much before it, for it would hit the corner's own wall [m]


@dataclass(frozen=True)
class SensorModel:
    """Standard deviations and reach.

    Attributes:
        range_max: greatest distance to a cylinder's axis or a corner that is seen [m].
        sigma_range: [m].
        sigma_bearing: [rad].
        sigma_radius: of a cylinder's radius [m].
        sigma_height: [m].
        sigma_tilt: of each component of R' e3.
        sigma_gyro: of each body rate [rad/s].
        sigma_force: of each component of the specific force [m/s^2].
        sigma_force_bias: of what its sensor shows too much, throughout [m/s^2].
        misses: share of the sightings that are missing.
        clutter: false cylinders of a reading, on average, anywhere within reach.
    """

    range_max: float = 8.0
    sigma_range: float = 0.05
    sigma_bearing: float = 0.01
    sigma_radius: float = 0.0
    sigma_height: float = 0.03
    sigma_tilt: float = 0.01
    sigma_gyro: float = 0.01
    sigma_force: float = 0.1
    sigma_force_bias: float = 0.05
    misses: float = 0.0
    clutter: float = 0.0

    @staticmethod
    def exact(range_max: float = 8.0) -> SensorModel:
        """A sensor without noise."""
        return SensorModel(range_max, *[0.0] * 8)


class Sensor:
    """Sensors with a stream of noise each.

    Every reading draws the same amount from every stream, whatever is seen: two controllers under one seed meet the
    same noise, and movers do not shift that of what stands.
    """

    def __init__(
        self,
        model: SensorModel,
        first: First,
        shapes: Sequence[pymunk.Shape | None],
        standing: int,
        rng: np.random.Generator,
    ) -> None:
        """Look around.

        Args:
            model: noise and reach.
            first: of the shapes that a ray meets.
            shapes: shape of each thing by id; None for a corner.
            standing: number of things that do not move; the rest do.
            rng: its children are spawned, itself it is not advanced.
        """
        self.model = model
        self._first, self._shapes = first, tuple(shapes)
        self._standing, self._moving = standing, len(shapes) - standing
        self._kinds = np.array(
            [Landmarks.CORNER if shape is None else Landmarks.CYLINDER for shape in shapes], dtype=np.intp
        )
        *self._streams, self._felt = rng.spawn(6)
        self._lost, self._false = self._felt.spawn(2)
        self._bias = model.sigma_force_bias * self._felt.standard_normal(3)

    def read(self, time: float, state: Array, things: Array, rates: Array, force: Array) -> Reading:
        """Measure once; every call draws new noise.

        Args:
            time: [s].
            state: (10,) true state.
            things: (n, 3) x, y, radius of everything by id [m].
            rates: (3,) true mean body rates [rad/s].
            force: (3,) true mean specific force [m/s^2].
        """
        model = self.model
        standing, moving, height, tilt, gyro = self._streams
        noise = np.concatenate(
            [standing.standard_normal((self._standing, 3)), moving.standard_normal((self._moving, 3))]
        )
        height_noise, tilt_noise, gyro_noise = (
            height.standard_normal(),
            tilt.standard_normal(3),
            gyro.standard_normal(3),
        )
        rotation = SO3.matrix(state[None, 3:7])[0]
        offset = things[:, :2] - state[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        reached = (distance <= model.range_max) & (self._lost.uniform(size=len(things)) >= model.misses)
        ids = np.array([i for i in np.flatnonzero(reached) if self._visible(int(i), state, things)], dtype=np.intp)
        heading = math.atan2(rotation[1, 0], rotation[0, 0])
        bearings = np.arctan2(offset[ids, 1], offset[ids, 0]) - heading + model.sigma_bearing * noise[ids, 0]
        reading = Reading(
            time=time,
            ids=ids,
            bearings=(bearings + np.pi) % (2.0 * np.pi) - np.pi,
            ranges=np.maximum(distance[ids] + model.sigma_range * noise[ids, 1], 0.0),
            radii=np.where(
                self._kinds[ids] == Landmarks.CORNER,
                0.0,
                np.maximum(things[ids, 2] + model.sigma_radius * noise[ids, 2], 0.0),
            ),
            kinds=self._kinds[ids],
            moving=ids >= self._standing,
            height=float(state[2] + model.sigma_height * height_noise),
            tilt=rotation[2] + model.sigma_tilt * tilt_noise,
            rates=rates + model.sigma_gyro * gyro_noise,
            force=force + self._bias + model.sigma_force * self._felt.standard_normal(3),
        )
        return self._cluttered(reading)

    def _cluttered(self, reading: Reading) -> Reading:
        """A reading with false sightings behind the others, which have no name."""
        rng, model = self._false, self.model
        count = int(rng.poisson(model.clutter))
        bearings, shares = rng.uniform(-np.pi, np.pi, count), rng.uniform(size=count)
        radii = rng.uniform(*_FALSE_RADII, count)
        if not count:
            return reading
        return replace(
            reading,
            ids=np.append(reading.ids, np.full(count, NOTHING)),
            bearings=np.append(reading.bearings, bearings),
            ranges=np.append(reading.ranges, model.range_max * np.sqrt(shares)),
            radii=np.append(reading.radii, radii),
            kinds=np.append(reading.kinds, np.full(count, Landmarks.CYLINDER)),
            moving=np.append(reading.moving, np.zeros(count, dtype=bool)),
        )

    def _visible(self, index: int, state: Array, things: Array) -> bool:
        """Return True if a ray to the axis, or one to either flank, meets this thing first; one to a corner nothing."""
        x, y, radius = things[index].tolist()
        origin, shape = (float(state[0]), float(state[1])), self._shapes[index]
        dx, dy = x - origin[0], y - origin[1]
        distance = math.hypot(dx, dy)
        if distance <= (_CORNER_GAP if shape is None else radius):
            return True
        share, angles = 1.0 - _CORNER_GAP / distance, [0.0]
        if shape is not None:
            flank = _FLANK * math.asin(radius / distance)
            share, angles = 1.0, [0.0, flank, -flank]
        for angle in angles:
            c, s = math.cos(angle), math.sin(angle)
            tip = origin[0] + share * (c * dx - s * dy), origin[1] + share * (s * dx + c * dy)
            if self._first(origin, tip) is shape:
                return True
        return False
