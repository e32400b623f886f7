"""Estimator of the quadrotor's state, parameters and landmarks: a sliding window, solved anew at each tick.

:class:`Estimator` knows the dynamics: controls, process noise and the unknown parameters tie the states to each other.
With :class:`DeadReckoning` in their place it has the same sensors and does not.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from unifg.models import quadrotor
from unifg.models.matching import DOUBTFUL, NEW, Gates, nearest
from unifg.scenarios.options import AtLeastOne, Positive, Settings, option
from unifg.scenarios.perception.association import expected, places
from unifg.scenarios.perception.atlas import Atlas
from unifg.scenarios.perception.belief import Belief, Landmarks
from unifg.scenarios.perception.readings import Reading
from unifg.scenarios.quadrotor.flight_past import (
    PARAMETER_SIZE,
    STATE_SIZE,
    UNKNOWN,
    Survey,
    WindowSettings,
    packed,
    robot,
    window,
)
from unifg.solvers import SQP
from unifg.typing import Array, BoolArray, IntArray

logger = logging.getLogger("unifg")

FIRST_LANDMARK = STATE_SIZE + PARAMETER_SIZE  # column in the joint covariance
ASSOCIATIONS = ("known", "unknown")
SAME_CORNER = 1.0  # [m]; a corner seen nearer than this to one on the map is that one
LIGHTEST = 0.01  # [kg]
STILL = np.zeros(2)  # nothing pushes
TOLERANCE = 1e-3  # of the KKT test, and of the dynamics in their own units


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Initial belief, and settings of the window.

    Attributes:
        window: sizes, noise and sensors.
        position_sigma, attitude_sigma, velocity_sigma: of the state at the start [m, rad, m/s].
        mass_sigma: of the mass, relative to its guess.
        drag_sigma: of each coefficient [kg/s].
        wind_sigma, updraft_sigma: [m/s^2].
        association: whether the sensor names what it sees, or who is who is found by gating.
        gates: for unknown association.
        confirmation: M and N: of unknown association a cylinder counts once M of the last N readings show it.
        iterations: SQP iterations per tick.
        manoeuvre_sigma: acceleration that an estimator without dynamics expects over a tick [m/s^2].

    Raises:
        ScenarioError: on an unknown association.
    """

    window: WindowSettings = field(default_factory=WindowSettings)
    position_sigma: Positive[float] = 0.05
    attitude_sigma: Positive[float] = 0.02
    velocity_sigma: Positive[float] = 0.05
    mass_sigma: Positive[float] = 0.08
    drag_sigma: Positive[float] = 0.1
    wind_sigma: Positive[float] = 0.5
    updraft_sigma: Positive[float] = 0.3
    association: str = option("known", choices=ASSOCIATIONS)
    gates: Gates = field(default_factory=Gates)
    confirmation: tuple[int, int] = (1, 1)
    iterations: AtLeastOne = 2
    manoeuvre_sigma: Positive[float] = 3.0

    @property
    def state_sigma(self) -> Array:
        """(9,) of the right perturbation of the state at the start."""
        return np.repeat([self.position_sigma, self.attitude_sigma, self.velocity_sigma], 3)

    def parameters_sigma(self, nominal: quadrotor.Parameters) -> Array:
        """(7,) in the order of ``nominal.packed``."""
        sigmas = [self.mass_sigma * nominal.mass, self.drag_sigma, self.wind_sigma, self.updraft_sigma]
        return np.repeat(sigmas, [1, 3, 2, 1])


@dataclass(frozen=True)
class Dynamics:
    """Motion from one reading to the next by the controller's dynamics.

    Attributes:
        nominal: parameters believed at the start.
    """

    nominal: quadrotor.Parameters

    def window(self, settings: EstimatorSettings) -> WindowSettings:
        """Sizes and noise."""
        return settings.window

    def start(self) -> Array:
        """(7,) parameters at the start."""
        return self.nominal.packed

    def motion(self, reading: Reading, control: Array) -> tuple[Array, Array]:
        """Control (4,) that stands in the dynamics, and what the gyro saw beyond it (3,)."""
        return control, reading.rates - control[:3]

    def pushed(self, push: Array) -> Array:
        """Effect of a measured push (2,) on the model, beside its own forces [m/s^2]."""
        return push

    def believed(self, parameters: Array) -> quadrotor.Parameters:
        """Belief of a window that holds ``parameters`` (7,)."""
        return flyable(parameters)


@dataclass(frozen=True)
class DeadReckoning(Dynamics):
    """Constant velocity disturbed by accelerations, attitude by the gyro.

    A body without thrust and drag, in an updraft that carries its weight, moves just so; the window's terms are the
    same. Nothing is learnt about mass, drag and wind: they stay nominal.
    """

    def window(self, settings: EstimatorSettings) -> WindowSettings:
        """Nothing is estimated, and manoeuvres are noise."""
        own = settings.window
        gyro = own.gyro_sigma if own.gyro_sigma is not None else own.noise_sigma[0]
        sigma = (*[gyro] * 3, *[settings.manoeuvre_sigma] * 3)
        return replace(own, estimated=(), noise_sigma=sigma, gyro_sigma=None)

    def start(self) -> Array:
        """Those of a body that floats."""
        return quadrotor.Parameters(updraft=quadrotor.GRAVITY).packed

    def motion(self, reading: Reading, control: Array) -> tuple[Array, Array]:
        """The gyro's rates without thrust; nothing beyond them."""
        return np.concatenate([reading.rates, [0.0]]), np.zeros(3)

    def pushed(self, push: Array) -> Array:
        """Nothing: every force is a manoeuvre to it."""
        return np.zeros(2)

    def believed(self, parameters: Array) -> quadrotor.Parameters:
        """Nothing else than at the start."""
        return self.nominal


class Estimator:
    """A fixed-lag smoother of state, mass, drag, wind and landmarks (Ta et al. 2014, section II-B).

    :meth:`update` is :meth:`predict`, :meth:`see` and :meth:`estimate`.

    Attributes:
        settings: priors and noise.
        own: sizes, noise and sensors of the window.
        model: how the vehicle moves.
        window: the past; a joint graph of past and future works on the same one.
        survey: which landmarks are on the map from the start.
        atlas: what the landmarks' slots hold.
        covariance: (D, D) of state, parameters and landmarks' slots, from past terms only.
    """

    def __init__(
        self,
        state: Array,
        nominal: quadrotor.Parameters,
        settings: EstimatorSettings | None = None,
        survey: Array | None = None,
        model: Dynamics | None = None,
    ) -> None:
        """State the graph and prepare its solver.

        Args:
            state: (10,) believed at the start.
            nominal: parameters believed at the start.
            settings: priors and noise.
            survey: (C, 2) corners that are on the map [m]; None for none.
            model: how the vehicle moves; None for the controller's dynamics.
        """
        self.settings = settings = settings or EstimatorSettings()
        self._corners = np.zeros((0, 2)) if survey is None else np.asarray(survey, dtype=np.float64)
        self.model = model or Dynamics(nominal)
        self.own = own = self.model.window(settings)
        parameters, sigma = self.model.start(), settings.parameters_sigma(nominal)
        state = np.asarray(state, dtype=np.float64)
        self.survey, self.atlas = Survey(own), Atlas(own.landmarks)
        # The guess keeps the dynamics to rounding: with a sharper tolerance a step that bends them counts as worse.
        solver = SQP(max_iterations=settings.iterations, full_steps=True, tolerance=TOLERANCE, step_tolerance=1e-4)
        vehicle = robot(own, state, parameters, sigma)
        self.window = window(own, vehicle, self.survey, state, settings.state_sigma, solver)
        self.covariance = np.zeros((FIRST_LANDMARK + 2 * own.landmarks,) * 2)
        self.covariance[:STATE_SIZE, :STATE_SIZE] = np.diag(settings.state_sigma**2)
        self._seen_as = np.full(own.landmarks, -1, dtype=np.intp)  # by slot: what the last sighting was called
        self._time: float | None = None

    @property
    def parameters(self) -> Array:
        """(7,) believed mass, drag, wind and updraft."""
        return packed(self.window.history.constants)

    @property
    def landmarks(self) -> Array:
        """(K, 2) believed places of the slots [m]."""
        return self.window.history.constants["landmarks"]

    def update(self, reading: Reading, control: Array | None, push: Array = STILL) -> Belief:
        """Take in one reading.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
            push: as for :meth:`predict`.
        """
        self.predict(reading, control, push)
        self.see(reading)
        return self.estimate()

    def predict(self, reading: Reading, control: Array | None, push: Array = STILL) -> None:
        """Move the window on to the time of a reading.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
            push: (2,) horizontal acceleration in the world that was felt meanwhile and that no model holds [m/s^2]. The
                noise of the step is expected to be that; or else velocity and wind, which nothing measures, take it up.
        """
        if self._time is not None and control is not None:
            dt = reading.time - self._time
            control, turned = self.model.motion(reading, np.asarray(control, dtype=np.float64))
            noise = np.zeros(6)
            noise[:3] = turned * self._gain()
            moved = control + np.concatenate([noise[:3], [0.0]])
            push = self.model.pushed(push)
            state = quadrotor.step(self.window.present[None], moved[None], dt, flyable(self.parameters))[0]
            if push.any():
                noise[3:5] = push
                state[:2] += 0.5 * dt**2 * push
                state[7:9] += dt * push
            self._propagate(state, control, noise, dt)
            self.window.move(control, self.window.history.times[-1] + dt, state, {"noise": noise})
            self.window.record("turned", turned)
            self.window.record("push", push)
            if self.own.force_sigma is not None:
                self.window.record("force", reading.force)
        self._time = reading.time

    def see(self, reading: Reading) -> None:
        """Attach a reading to the present; what moves is tracked elsewhere, and leaves the map when it turns out to."""
        window, atlas = self.window, self.atlas
        window.record("height", reading.height)
        window.record("tilt", reading.tilt)
        window.record("sightings", np.zeros((self.own.landmarks, 3)))
        present = window.history.recorded("sightings")[0][-1]
        atlas.tick()
        for mover in np.flatnonzero(atlas.used & np.isin(self._seen_as, reading.ids[reading.moving])).tolist():
            self._strike(mover)
        own = np.flatnonzero(~reading.moving)
        sightings = np.column_stack([reading.bearings, reading.ranges])[own]
        slots = self._associate(reading, own, sightings)
        for row, (bearing, distance), slot in zip(own.tolist(), sightings.tolist(), slots.tolist(), strict=True):
            if slot == DOUBTFUL:
                continue
            if slot == NEW:
                slot = self._slot()
                if slot is None:
                    continue
                place = places(window.present, np.array([bearing]), np.array([distance]))[0]
                window.admit("landmarks", slot, place, UNKNOWN)
                name = int(reading.ids[row]) if self.settings.association == "known" else None
                atlas.admit(slot, int(reading.kinds[row]), name)
                self._look_up(slot)
            present[slot] = bearing, distance, 1.0
            self._seen_as[slot] = reading.ids[row]
            atlas.sight(slot, float(reading.radii[row]))

    def estimate(self) -> Belief:
        """Solve the window."""
        self.window.estimate()
        self.covariance = self.window.covariance
        return self.belief()

    def belief(self) -> Belief:
        """Belief of now."""
        window = self.window
        spread = self.covariance[FIRST_LANDMARK:, FIRST_LANDMARK:]
        return Belief(
            state=window.present.copy(),
            covariance=self.covariance[:STATE_SIZE, :STATE_SIZE].copy(),
            parameters=self.model.believed(self.parameters),
            parameters_sigma=np.sqrt(np.diag(self.covariance)[STATE_SIZE:FIRST_LANDMARK]),
            landmarks=self.atlas.landmarks(self.landmarks, spread),
        )

    # ---------------------------------------------------------------- steps

    def _gain(self) -> Array:
        """(3,) share of the gyro's deviation that is noise of the rates and not of the gyro."""
        own = self.own
        process = np.square(own.noise_sigma[:3])
        return process / (process + (own.gyro_sigma or 0.0) ** 2)

    def _propagate(self, state: Array, control: Array, noise: Array, dt: float) -> None:
        """Covariance of the prediction, by the derivatives of the dynamics: A dx + W dw + P drho + B dx' = 0."""
        rho = np.split(self.parameters[None], [1, 4, 6], axis=1)
        arguments = (self.window.present[None], control[None], noise[None], *rho, state[None], dt)
        A, _, W, mass, drag, wind, updraft, B = (block[0] for block in DYNAMICS.jacobian(*arguments))
        moved = -np.linalg.solve(B, np.concatenate([A, mass, drag, wind, updraft, W], axis=1))
        before = self.covariance
        F, G = moved[:, :FIRST_LANDMARK], moved[:, FIRST_LANDMARK:]
        across = F @ before[:FIRST_LANDMARK]
        after = before.copy()
        after[:STATE_SIZE], after[:, :STATE_SIZE] = across, across.T
        own = self.own
        sigma = np.array(own.noise_sigma)
        if own.gyro_sigma is not None:
            sigma[:3] = 1.0 / np.sqrt(1.0 / sigma[:3] ** 2 + 1.0 / own.gyro_sigma**2)
        after[:STATE_SIZE, :STATE_SIZE] = across[:, :FIRST_LANDMARK] @ F.T + (G * sigma**2) @ G.T
        self.covariance = after

    def _associate(self, reading: Reading, own: IntArray, sightings: Array) -> IntArray:
        """Slot of each sighting, ``NEW`` or ``DOUBTFUL``."""
        atlas = self.atlas
        if self.settings.association == "known":
            return np.array([atlas.slot_of(int(name)) for name in reading.ids[own]], dtype=np.intp)
        used = np.flatnonzero(atlas.used)
        if not len(used):
            return np.full(len(own), NEW, dtype=np.intp)
        noise = np.array([self.own.bearing_sigma, self.own.range_sigma])
        columns = FIRST_LANDMARK + 2 * used
        forecast, innovation = expected(self.window.present, self.covariance, self.landmarks[used], columns, noise)
        possible = reading.kinds[own][:, None] == atlas.kinds[used][None]
        pairs = nearest(sightings, forecast, innovation, possible, self.settings.gates)
        return np.where(pairs >= 0, used[np.maximum(pairs, 0)], pairs)

    def _slot(self) -> int | None:
        """A free slot, if need be that of the landmark not seen for longest; None when the window sees them all."""
        slot = self.atlas.free_slot()
        if slot is not None:
            return slot
        sightings = self.window.history.recorded("sightings")[0]
        out_of_sight: BoolArray = ~np.any(sightings[:, :, 2] > 0.0, axis=0)
        slot = self.atlas.oldest(out_of_sight)
        if slot is None:
            logger.debug("all slots hold landmarks that the window sees: a new one is left out")
            return None
        place = slice(FIRST_LANDMARK + 2 * slot, FIRST_LANDMARK + 2 * slot + 2)
        self.atlas.retire(slot, self.landmarks[slot], self.covariance[place, place])
        self.window.forget("landmarks", slot)
        self.survey.known[slot] = False
        return slot

    def _strike(self, slot: int) -> None:
        """Take what moves off the map, with all that was believed to be seen of it."""
        self.window.history.recorded("sightings")[0][:, slot] = 0.0
        self.window.forget("landmarks", slot)
        self.atlas.strike(slot)
        self._seen_as[slot] = -1

    def _look_up(self, slot: int) -> None:
        """Find a new corner on the map."""
        if self.atlas.kinds[slot] != Landmarks.CORNER or not len(self._corners):
            return
        gaps = np.hypot(*(self._corners - self.landmarks[slot]).T)
        nearest = int(np.argmin(gaps))
        if gaps[nearest] < SAME_CORNER:
            self.survey.places[slot], self.survey.known[slot] = self._corners[nearest], True


def flyable(packed: Array) -> quadrotor.Parameters:
    """Parameters from an estimate (7,), which may lie where none can: mass is positive, drag not negative."""
    parameters = packed.copy()
    parameters[0] = max(parameters[0], LIGHTEST)
    parameters[1:4] = np.maximum(parameters[1:4], 0.0)
    return quadrotor.Parameters.unpacked(parameters)


assert quadrotor.disturbed_dynamics.kernel is not None
DYNAMICS = quadrotor.disturbed_dynamics.kernel
