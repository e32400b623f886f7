"""The simulated truth of a flight: a 3-D integrator for the vehicle, pymunk for what it can run into.

The state is integrated by :func:`unifg.models.quadrotor.fly` in substeps with parameters and disturbances that the
controller does not know. The vehicle's disc lives in a space with the cylinders, the walls and the movers. In each
substep the disc is given the velocity that takes it where the integrator has gone, less the parts into things it
touches already; where it does not arrive, the 3-D state takes the disc's position and loses the velocity into what
holds it. Without a contact the disc arrives to rounding, and a first contact overlaps by one substep's motion at most
(1 cm at 2 m/s).

What the vehicle may know of this world is what `QuadrotorWorld.sense` returns; everything else is ground truth for
metrics and pictures.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.models.footprint import Body
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.planning.passage import obstacle_distance
from unifg.scenarios.simulation.bearing_range import Sensor, SensorModel
from unifg.scenarios.simulation.disturbance import DisturbanceModel, Disturbances
from unifg.scenarios.simulation.layouts import Layout
from unifg.scenarios.simulation.placement import random_mover
from unifg.scenarios.simulation.space import OTHERS, Obstacle, Space
from unifg.typing import Array, ArrayLike

__all__ = ["VEHICLE_RADIUS", "QuadrotorWorld"]

VEHICLE_RADIUS = 0.25
"""Radius of the vehicle's disc on the ground plane [m]; it has no height, and its tilt is not looked at."""

UP = np.array([0.0, 0.0, quadrotor.GRAVITY])
"""Specific force at rest, in the world [m/s^2]."""

_ARRIVED = 1e-9  # [m]
_WORLD_TAG = 53  # keeps the noise apart from the layouts of the same seed
SOFT = 0.8
"""Speed at which a vehicle may touch the floor [m/s]: a landing is no collision."""

FLOOR = -1
"""Owner of contacts with the floor; those of things are their ids, those of walls follow."""


class QuadrotorWorld(Space):
    """One vehicle among cylinders, walls and movers, above a floor.

    Things are named by id: cylinders of the layout first, then the walls' corners, then the movers.

    Attributes:
        layout: what stands.
        parameters: true parameters of the vehicle.
        sensor_model: noise and reach of the sensors.
        disturbance_model: statistics of the disturbances.
        movers: what moves.
        grounded: whether the vehicle has touched the floor in the last step.
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
        if isinstance(movers, int):
            movers = [random_mover(layout, index, mover_rng) for index in range(movers)]
        self.movers = tuple(movers)
        self._disturbances = Disturbances(self.disturbance_model, disturbance_rng)
        self.grounded = False
        self._state = _start_state(layout, start)
        self._rates, self._force = np.zeros(3), SO3.act(SO3.inverse(self._state[3:7]), UP)
        super().__init__(self._state[:2], Body.disc(VEHICLE_RADIUS))
        if self._state[2] <= 0.0:
            self.begin(FLOOR, counts=False)  # a start on the ground is no collision
        shapes = self._add_things()
        self.add_vehicle()
        self._sensor = Sensor(self.sensor_model, self.first_met, shapes, len(shapes) - len(self.movers), sensor_rng)
        if self.clearance() < 0.0:
            x, y, z = self._state[:3]
            raise ScenarioError(
                f"the vehicle (radius {VEHICLE_RADIUS:g} m) cannot start at ({x:g}, {y:g}, {z:g}): it would overlap "
                f"an obstacle or the floor by {-self.clearance():.2f} m; choose a free start in layout {layout.name!r}"
            )

    def _add_things(self) -> list[pymunk.Shape | None]:
        """Shapes by id, None for corners; walls are added too, their ends are what is named."""
        layout, static = self.layout, self.engine.static_body
        shapes: list[pymunk.Shape | None] = []
        for x, y, radius in layout.cylinders.tolist():
            shapes.append(self.add(pymunk.Circle(static, radius, (x, y)), len(shapes)))
        shapes += [None] * len(layout.corners)
        for obstacle in self.movers:
            shapes.append(self.add_disc(obstacle, len(shapes)))
        for index, (begin, end) in enumerate(layout.walls.tolist()):
            wall = pymunk.Segment(static, (begin[0], begin[1]), (end[0], end[1]), 0.0)
            self.add(wall, len(shapes) + index)
        return shapes

    # ------------------------------------------------------------------ motion

    def step(self, control: ArrayLike, dt: float = 0.05) -> None:
        """Fly under a held control for a while.

        Args:
            control: (4,) body rates [rad/s] and thrust [N].
            dt: duration [s].

        Raises:
            ScenarioError: if the control or the duration is not usable.
        """
        u, rates, path = usable(control), list[Array](), [self._state]
        for pause in self.substeps(dt):
            noise = self._disturbances.draw(pause)
            rates.append(u[:3] + noise[:3])
            flown = quadrotor.fly(self._state, u, pause, self.parameters, noise, substeps=1)
            self._state = self._land(self._collide(flown, pause))
            path.append(self._state)
        self._rates = sum(rates, np.zeros(3)) / len(rates)
        self._force = felt_force(np.array(path), np.array(rates), dt / len(rates))
        self.grounded = any(state[2] <= 0.0 for state in path[1:])

    def _collide(self, flown: Array, pause: float) -> Array:
        """Let the disc follow the integrator as far as it can; the state (10,) that is left."""
        body, wanted = self.vehicle, pymunk.Vec2d(float(flown[0]), float(flown[1]))
        body.velocity = self.without_contacts((wanted - body.position) / pause)
        self.advance(pause)  # movers do not wait: their path is the same in every flight
        if body.position.get_distance(wanted) > _ARRIVED:
            flown[:2] = body.position
        flown[7:9] = self.without_contacts(pymunk.Vec2d(float(flown[7]), float(flown[8])))
        return flown

    def _land(self, state: Array) -> Array:
        """Keep a state (10,) above the floor."""
        if state[2] <= 0.0:
            if not self.touches(FLOOR):
                self.begin(FLOOR, counts=float(np.linalg.norm(state[7:10])) > SOFT)
            state[2], state[9] = 0.0, max(state[9], 0.0)
        elif self.touches(FLOOR):
            self.separate(FLOOR)
        return state

    # ----------------------------------------------------------------- sensors

    def sense(self) -> Reading:
        """Measure once at the present state; every call draws new noise."""
        return self._sensor.read(self.time, self._state, self.things(), self._rates, self._force)

    def first_met(self, origin: tuple[float, float], tip: tuple[float, float]) -> pymunk.Shape | None:
        """First shape that a ray meets between two places [m]; None for none."""
        hit = self.engine.segment_query_first(origin, tip, 0.0, OTHERS)
        return None if hit is None else hit.shape

    # ------------------------------------------------------------ ground truth

    @property
    def state(self) -> Array:
        """(10,) true position, quaternion (w, x, y, z) and velocity."""
        return self._state.copy()

    def things(self) -> Array:
        """(n, 3) x, y, radius of everything that can be seen, by id, as it stands now [m]; corners have radius 0."""
        corners = self.layout.corners
        return np.concatenate(
            [self.layout.cylinders, np.column_stack([corners, np.zeros(len(corners))]), self.discs()[:, :3]]
        )

    def clearance(self) -> float:
        """Distance from the hull to the nearest cylinder, mover, wall or the floor [m]; negative in an overlap."""
        discs = np.concatenate([self.layout.cylinders, self.discs()[:, :3]])
        beside = float(obstacle_distance(self._state[None, :2], discs, self.layout.walls)[0]) - VEHICLE_RADIUS
        return min(beside, float(self._state[2]))


def usable(control: ArrayLike) -> Array:
    """(4,) body rates [rad/s] and thrust [N].

    Raises:
        ScenarioError: these are not four finite numbers.
    """
    u = np.array(control, dtype=np.float64)
    if u.shape != (4,) or not np.isfinite(u).all():
        raise ScenarioError(
            f"a control is four finite numbers, body rates and thrust; got {control!r}. Fly a stored plan or hover "
            "rather than a plan that failed"
        )
    return u


def felt_force(states: Array, rates: Array, pause: float) -> Array:
    """Mean (3,) of what an accelerometer in the body feels along a path, of contacts too [m/s^2].

    Args:
        states: (n + 1, 10).
        rates: (n, 3) of the body between them [rad/s].
        pause: time between them [s].
    """
    halfway = SO3.retract(states[:-1, 3:7], 0.5 * pause * rates)
    pushed = np.diff(states[:, 7:], axis=0) / pause + UP
    mean: Array = SO3.act(SO3.inverse(halfway), pushed).mean(axis=0)
    return mean


def _start_state(layout: Layout, start: ArrayLike | None) -> Array:
    if start is None:
        return np.concatenate([layout.start, [1.0, 0.0, 0.0, 0.0], np.zeros(3)])
    state = np.array(start, dtype=np.float64)
    if state.shape != (10,) or not np.isfinite(state).all() or abs(np.linalg.norm(state[3:7]) - 1.0) > 1e-6:
        raise ScenarioError(
            f"start must be ten finite numbers, position, unit quaternion (w, x, y, z) and velocity; got {start!r}"
        )
    return state
