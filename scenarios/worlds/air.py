"""The simulated truth of a flight: a 3-D integrator for the vehicle, pymunk for what it can run into.

The state is integrated by :func:`unifg.models.quadrotor.fly` in substeps of 5 ms with parameters and disturbances
that the controller does not know. The vehicle's disc lives in a pymunk space with the cylinders, the walls and the
movers. In each substep the disc is given the velocity that takes it where the integrator has gone, less the parts
into things it touches already; where it does not arrive, the 3-D state takes the disc's position and loses the
velocity into what holds it. The engine moves bodies before it looks for contacts, so without one the disc arrives to
rounding, and a first contact overlaps by one substep's motion at most (1 cm at 2 m/s).

What the vehicle may know of this world is what `QuadrotorWorld.sense` returns; everything else is ground truth for
metrics and pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.models import quadrotor
from unifg.scenarios.ways.passage import obstacle_distance
from unifg.scenarios.worlds.bearing_range import Reading, Sensor, SensorModel
from unifg.scenarios.worlds.disturbance import DisturbanceModel, Disturbances
from unifg.scenarios.worlds.layouts import Layout
from unifg.scenarios.worlds.random_movers import random_movers
from unifg.scenarios.worlds.unmapped import Mover, Obstacle
from unifg.typing import Array, ArrayLike

__all__ = ["VEHICLE_RADIUS", "DisturbanceModel", "QuadrotorWorld", "Reading", "SensorModel"]

VEHICLE_RADIUS = 0.25
"""Radius of the vehicle's disc on the ground plane [m]; it has no height, and its tilt is not looked at."""

_SUBSTEP = 0.005  # [s]
_EVENT_GAP = 0.5  # [s]; a contact renewed sooner belongs to the same event
_ARRIVED = 1e-9  # [m]
_WORLD_TAG = 53  # keeps the noise apart from the layouts of the same seed

_VEHICLE_CATEGORY = 1
_VEHICLE_TYPE = 1
_THING_TYPE = 2
_OTHERS = pymunk.ShapeFilter(mask=pymunk.ShapeFilter.ALL_MASKS() ^ _VEHICLE_CATEGORY)
_FLOOR = -1  # owner of contacts with the floor; those of things are their ids, those of walls follow


class QuadrotorWorld:
    """One vehicle among cylinders, walls and movers, above a floor.

    Things are named by id: cylinders of the layout first, then the walls' corners, then the movers.

    Attributes:
        layout: what stands.
        parameters: true parameters of the vehicle.
        sensor_model: noise and reach of the sensors.
        disturbance_model: statistics of the disturbances.
        movers: what moves.
        collisions: contact events so far, with the floor too; contacts with one thing less than 0.5 s apart are one.
    """

    def __init__(
        self,
        layout: Layout,
        seed: int,
        parameters: quadrotor.Parameters | None = None,
        movers: int | Sequence[Obstacle] = 0,
        *,
        start: ArrayLike | None = None,
        sensor: SensorModel | None = None,
        disturbance: DisturbanceModel | None = None,
    ) -> None:
        """Place everything.

        Args:
            layout: what stands, where the vehicle starts and where it is to go.
            seed: of sensors, disturbances and movers, each with a stream of its own.
            parameters: true mass, drag and wind; None for 1 kg in calm air.
            movers: how many to draw, or the movers themselves.
            start: (10,) state at time zero; None for the layout's start, level and at rest.
            sensor: None for the defaults of :class:`SensorModel`.
            disturbance: None for the defaults of :class:`DisturbanceModel`.

        Raises:
            ScenarioError: if the start is not a state, lies below the floor or overlaps an obstacle, or there is no
                room for the movers.
        """
        self.layout = layout
        self.parameters = parameters or quadrotor.Parameters()
        self.sensor_model = sensor or SensorModel()
        self.disturbance_model = disturbance or DisturbanceModel()
        sensor_rng, disturbance_rng, mover_rng = np.random.default_rng([_WORLD_TAG, seed]).spawn(3)
        self.movers = random_movers(layout, movers, mover_rng) if isinstance(movers, int) else tuple(movers)
        self._disturbances = Disturbances(self.disturbance_model, disturbance_rng)
        self._state = _start_state(layout, start)
        self._rates = np.zeros(3)
        self._time = 0.0
        self.collisions = 0
        self._touching: dict[int, int] = {_FLOOR: int(self._state[2] <= 0.0)}  # a start on the ground is no collision
        self._separated: dict[int, float] = {}

        self._space = pymunk.Space()
        self._space.collision_slop = 1e-4  # the engine's default lets shapes overlap by 0.1 m
        self._space.collision_bias = 1e-6
        self._owner: dict[pymunk.Shape, int] = {}
        self._mover_bodies: list[Mover] = []
        shapes = self._add_things()
        self._body = self._add_vehicle()
        self._space.on_collision(_VEHICLE_TYPE, _THING_TYPE, begin=self._on_begin, separate=self._on_separate)
        self._sensor = Sensor(
            self.sensor_model, self._space, shapes, len(shapes) - len(self.movers), _OTHERS, sensor_rng
        )
        if self.clearance() < 0.0:
            x, y, z = self._state[:3]
            raise ScenarioError(
                f"the vehicle (radius {VEHICLE_RADIUS:g} m) cannot start at ({x:g}, {y:g}, {z:g}): it would overlap "
                f"an obstacle or the floor by {-self.clearance():.2f} m; choose a free start in layout {layout.name!r}"
            )

    def _add_things(self) -> list[pymunk.Shape | None]:
        """Shapes by id, None for corners; walls are added too, their ends are what is named."""
        static = self._space.static_body
        shapes: list[pymunk.Shape | None] = []
        for x, y, radius in self.layout.cylinders.tolist():
            shapes.append(self._add_shape(pymunk.Circle(static, radius, (x, y)), len(shapes)))
        shapes += [None] * len(self.layout.corners)
        for obstacle in self.movers:
            end = obstacle.centre if obstacle.end is None else obstacle.end
            mover = Mover(obstacle, end)
            self._mover_bodies.append(mover)
            self._space.add(mover.body)
            shapes.append(self._add_shape(pymunk.Circle(mover.body, obstacle.radius), len(shapes)))
        for index, (begin, end) in enumerate(self.layout.walls.tolist()):
            wall = pymunk.Segment(static, (begin[0], begin[1]), (end[0], end[1]), 0.0)
            self._add_shape(wall, len(shapes) + index)
        return shapes

    def _add_shape(self, shape: pymunk.Shape, owner: int) -> pymunk.Shape:
        shape.collision_type = _THING_TYPE
        shape.filter = pymunk.ShapeFilter(categories=pymunk.ShapeFilter.ALL_MASKS() ^ _VEHICLE_CATEGORY)
        self._space.add(shape)
        self._owner[shape] = owner
        return shape

    def _add_vehicle(self) -> pymunk.Body:
        body = pymunk.Body(mass=1.0, moment=float("inf"))
        body.position = (float(self._state[0]), float(self._state[1]))
        shape = pymunk.Circle(body, VEHICLE_RADIUS)
        shape.collision_type = _VEHICLE_TYPE
        shape.filter = pymunk.ShapeFilter(categories=_VEHICLE_CATEGORY)
        self._space.add(body, shape)
        return body

    # ------------------------------------------------------------------ motion

    def step(self, control: ArrayLike, dt: float = 0.05) -> None:
        """Fly under a held control for a while.

        Args:
            control: (4,) body rates [rad/s] and thrust [N].
            dt: duration [s].

        Raises:
            ScenarioError: if the control or the duration is not usable.
        """
        u = np.array(control, dtype=np.float64)
        if u.shape != (4,) or not np.isfinite(u).all():
            raise ScenarioError(
                f"a control is four finite numbers, body rates and thrust; got {control!r}. Fly a stored plan or hover "
                "rather than a plan that failed"
            )
        if not (math.isfinite(dt) and dt > 0.0):
            raise ScenarioError(f"the duration of a step must be positive and finite, got {dt}")
        substeps = max(1, math.ceil(dt / _SUBSTEP - 1e-9))
        pause, start_time = dt / substeps, self._time
        rates = np.zeros(3)
        for count in range(substeps):
            noise = self._disturbances.draw(pause)
            rates += u[:3] + noise[:3]
            flown = quadrotor.fly(self._state, u, pause, self.parameters, noise, substeps=1)
            self._time = start_time + (count + 1) * pause
            self._state = self._land(self._collide(flown, pause))
        self._rates = rates / substeps

    def _collide(self, flown: Array, pause: float) -> Array:
        """Let the disc follow the integrator as far as it can; the state (10,) that is left."""
        body = self._body
        wanted = pymunk.Vec2d(float(flown[0]), float(flown[1]))
        body.velocity = self._without_contacts((wanted - body.position) / pause)
        for mover in self._mover_bodies:
            mover.advance(body, VEHICLE_RADIUS, False, pause)  # waits for nobody: its path is the same in every flight
        self._space.step(pause)
        if body.position.get_distance(wanted) > _ARRIVED:
            flown[:2] = body.position
        flown[7:9] = self._without_contacts(pymunk.Vec2d(float(flown[7]), float(flown[8])))
        return flown

    def _without_contacts(self, velocity: pymunk.Vec2d) -> pymunk.Vec2d:
        """A velocity without its parts into things touched, relative to their own motion."""
        contacts: list[tuple[pymunk.Vec2d, float]] = []

        def note(arbiter: pymunk.Arbiter) -> None:
            first, second = arbiter.shapes
            normal, thing = arbiter.contact_point_set.normal, second
            if first in self._owner:
                normal, thing = -normal, first
            assert thing.body is not None
            contacts.append((normal, thing.body.velocity.dot(normal)))

        self._body.each_arbiter(note)
        for _ in range(2 if contacts else 0):  # twice, for two things that are not square to one another
            for normal, allowed in contacts:
                velocity -= max(velocity.dot(normal) - allowed, 0.0) * normal
        return velocity

    def _land(self, state: Array) -> Array:
        """Keep a state (10,) above the floor."""
        if state[2] <= 0.0:
            self._begin(_FLOOR)
            state[2], state[9] = 0.0, max(state[9], 0.0)
        elif self._touching[_FLOOR]:
            self._separate(_FLOOR)
        return state

    # ---------------------------------------------------------------- contacts

    def _on_begin(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        self._begin(self._thing(arbiter))

    def _on_separate(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        self._separate(self._thing(arbiter))

    def _thing(self, arbiter: pymunk.Arbiter) -> int:
        first, second = arbiter.shapes
        return self._owner[first] if first in self._owner else self._owner[second]

    def _begin(self, owner: int) -> None:
        if not self._touching.get(owner, 0) and self._time - self._separated.get(owner, -math.inf) >= _EVENT_GAP:
            self.collisions += 1
        self._touching[owner] = 1

    def _separate(self, owner: int) -> None:
        self._touching[owner] = 0
        self._separated[owner] = self._time

    # ----------------------------------------------------------------- sensors

    def sense(self) -> Reading:
        """Measure once at the present state; every call draws new noise."""
        return self._sensor.read(self._time, self._state, self.things(), self._rates)

    # ------------------------------------------------------------ ground truth

    @property
    def state(self) -> Array:
        """(10,) true position, quaternion (w, x, y, z) and velocity."""
        return self._state.copy()

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._time

    def mover_states(self) -> Array:
        """(K, 3) x, y, radius of the movers now [m]."""
        rows = [(*mover.body.position, mover.radius) for mover in self._mover_bodies]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def things(self) -> Array:
        """(n, 3) x, y, radius of everything that can be seen, by id, as it stands now [m]; corners have radius 0."""
        corners = self.layout.corners
        return np.concatenate(
            [self.layout.cylinders, np.column_stack([corners, np.zeros(len(corners))]), self.mover_states()]
        )

    def clearance(self) -> float:
        """Distance from the hull to the nearest cylinder, mover, wall or the floor [m]; negative in an overlap."""
        discs = np.concatenate([self.layout.cylinders, self.mover_states()])
        beside = float(obstacle_distance(self._state[None, :2], discs, self.layout.walls)[0]) - VEHICLE_RADIUS
        return min(beside, float(self._state[2]))


def _start_state(layout: Layout, start: ArrayLike | None) -> Array:
    if start is None:
        return np.concatenate([layout.start, [1.0, 0.0, 0.0, 0.0], np.zeros(3)])
    state = np.array(start, dtype=np.float64)
    if state.shape != (10,) or not np.isfinite(state).all() or abs(np.linalg.norm(state[3:7]) - 1.0) > 1e-6:
        raise ScenarioError(
            f"start must be ten finite numbers, position, unit quaternion (w, x, y, z) and velocity; got {start!r}"
        )
    return state
