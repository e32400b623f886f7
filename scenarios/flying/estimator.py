"""Where is the vehicle, how heavy is it, where are the obstacles? A sliding window, solved anew at each tick.

:class:`Estimator` knows the dynamics: controls, process noise and the unknown parameters tie the states to each other.
With :class:`DeadReckoning` in their place it has the same sensors and does not.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import unifg as fg
from unifg.horizon.spread import JointCovariance
from unifg.models import quadrotor
from unifg.scenarios.flying.flight_terms import Shared, StateTerms
from unifg.scenarios.flying.flight_window import PARAMETER_SIZE, STATE_SIZE, StateWindow, WindowSettings
from unifg.scenarios.options import option
from unifg.scenarios.seeing.association import DOUBTFUL, NEW, Gates, expected, nearest, places
from unifg.scenarios.seeing.atlas import Atlas
from unifg.scenarios.seeing.belief import Belief, Landmarks
from unifg.scenarios.seeing.readings import Reading
from unifg.solvers import SQP
from unifg.typing import Array, BoolArray, IntArray

logger = logging.getLogger("unifg")

FIRST_LANDMARK = STATE_SIZE + PARAMETER_SIZE  # column in the joint covariance
ASSOCIATIONS = ("known", "unknown")
SAME_CORNER = 1.0  # [m]; a corner seen nearer than this to one on the map is that one
LIGHTEST = 0.01  # [kg]
TOLERANCE = 1e-3  # of the KKT test, and of the dynamics in their own units


@dataclass(frozen=True)
class EstimatorSettings:
    """What is believed before the first reading, and how the window is solved.

    Attributes:
        window: sizes, noise and sensors.
        position_sigma, attitude_sigma, velocity_sigma: of the state at the start [m, rad, m/s].
        mass_sigma: of the mass, relative to its guess.
        drag_sigma: of each coefficient [kg/s].
        wind_sigma, updraft_sigma: [m/s^2].
        association: whether the sensor names what it sees, or who is who is found by gating.
        gates: for unknown association.
        iterations: SQP iterations per tick.
        manoeuvre_sigma: acceleration that an estimator without dynamics expects over a tick [m/s^2].

    Raises:
        ScenarioError: on an unknown association.
    """

    window: WindowSettings = field(default_factory=WindowSettings)
    position_sigma: float = 0.05
    attitude_sigma: float = 0.02
    velocity_sigma: float = 0.05
    mass_sigma: float = 0.08
    drag_sigma: float = 0.1
    wind_sigma: float = 0.5
    updraft_sigma: float = 0.3
    association: str = option("known", choices=ASSOCIATIONS)
    gates: Gates = field(default_factory=Gates)
    iterations: int = 2
    manoeuvre_sigma: float = 3.0

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        if self.association not in ASSOCIATIONS:
            raise fg.ScenarioError(f"unknown association '{self.association}': choose {' or '.join(ASSOCIATIONS)}")

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
    """How the vehicle moves from one reading to the next: by the controller's dynamics.

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

    def believed(self, parameters: Array) -> quadrotor.Parameters:
        """What is believed where the window holds ``parameters`` (7,)."""
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

    def believed(self, parameters: Array) -> quadrotor.Parameters:
        """Nothing else than at the start."""
        return self.nominal


class Estimator:
    """A fixed-lag smoother of state, mass, drag, wind and landmarks (Ta et al. 2014, section II-B).

    :meth:`update` is :meth:`predict`, :meth:`see` and :meth:`estimate`. A joint graph of past and future solves the
    window itself, between :meth:`see` and :meth:`measure`.

    Attributes:
        settings: priors and noise.
        model: how the vehicle moves.
        window: the past; a joint graph of past and future works on the same one.
        terms: its terms in a graph of its own.
        atlas: what the landmarks' slots hold.
        covariance: (D, D) of state, parameters and landmarks' slots, from past terms only.
        solution: of the last tick.
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
        self._survey = np.zeros((0, 2)) if survey is None else np.asarray(survey, dtype=np.float64)
        self.model = model or Dynamics(nominal)
        own, parameters = self.model.window(settings), self.model.start()
        sigma = settings.parameters_sigma(nominal)
        self.window = StateWindow(own, state, np.diag(settings.state_sigma**2), parameters, sigma)
        self.atlas = Atlas(own.landmarks)
        self.covariance = np.zeros((FIRST_LANDMARK + 2 * own.landmarks,) * 2)
        self.covariance[:STATE_SIZE, :STATE_SIZE] = np.diag(settings.state_sigma**2)
        self._time: float | None = None
        graph = fg.Graph()
        self._present = graph.variables("present", quadrotor.STATE, 1)
        shared = Shared(graph, own, parameters)
        self.terms = StateTerms(graph, self._present[:], shared, own)
        # The guess keeps the dynamics to rounding: with a sharper tolerance a step that bends them counts as worse.
        solver = SQP(max_iterations=settings.iterations, full_steps=True, tolerance=TOLERANCE, step_tolerance=1e-4)
        self._run = solver.prepare(graph)
        self._spread = JointCovariance(self._run.program, self._present, *shared.parameters, shared.landmarks)
        self.solution: fg.Solution | None = None

    def update(self, reading: Reading, control: Array | None) -> Belief:
        """Take in one reading.

        Args:
            reading: of now.
            control: (4,) applied since the last reading; None at the first one.
        """
        self.predict(reading, control)
        self.see(reading)
        return self.estimate()

    def predict(self, reading: Reading, control: Array | None) -> None:
        """Move the window on to the time of a reading."""
        window = self.window
        if self._time is not None and control is not None:
            dt = reading.time - self._time
            control, turned = self.model.motion(reading, np.asarray(control, dtype=np.float64))
            noise = np.zeros(6)
            noise[:3] = turned * self._gain(dt)
            moved = control + np.concatenate([noise[:3], [0.0]])
            state = quadrotor.step(window.present[None], moved[None], dt, flyable(window.parameters))[0]
            self._propagate(state, control, noise, dt)
            window.move(control, dt, state, noise, turned)
        self._time = reading.time

    def see(self, reading: Reading) -> None:
        """Attach a reading to the present; what moves by design is tracked elsewhere."""
        window, atlas = self.window, self.atlas
        window.measure(reading.height, reading.tilt)
        atlas.tick()
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
                window.admit(slot, places(window.present, np.array([bearing]), np.array([distance]))[0])
                name = int(reading.ids[row]) if self.settings.association == "known" else None
                atlas.admit(slot, int(reading.kinds[row]), name)
                self._look_up(slot)
            window.sight(slot, bearing, distance)
            atlas.sight(slot, float(reading.radii[row]))

    def estimate(self) -> Belief:
        """Solve the window."""
        window, terms = self.window, self.terms
        guess = {**terms.guess(window), self._present: window.present[None]}
        self.solution = self._run.solve(guess, data=terms.data(window))
        terms.accept(window, self.solution)
        self.measure(self.solution.values)
        return self.belief()

    def measure(self, values: Mapping[fg.Family, Array]) -> None:
        """Find the covariance of the past's terms at ``values``, by families of this estimator's graph."""
        covariance = self._spread(values)
        if covariance is None:
            logger.warning("the window's information is singular: the covariance stays that of the prediction")
        else:
            self.covariance = covariance

    def belief(self) -> Belief:
        """What is known now."""
        window = self.window
        spread = self.covariance[FIRST_LANDMARK:, FIRST_LANDMARK:]
        return Belief(
            state=window.present.copy(),
            covariance=self.covariance[:STATE_SIZE, :STATE_SIZE].copy(),
            parameters=self.model.believed(window.parameters),
            parameters_sigma=np.sqrt(np.diag(self.covariance)[STATE_SIZE:FIRST_LANDMARK]),
            landmarks=self.atlas.landmarks(window.landmarks, spread),
        )

    # ---------------------------------------------------------------- steps

    def _gain(self, dt: float) -> Array:
        """(3,) share of the gyro's deviation that is noise of the rates and not of the gyro."""
        own = self.window.settings
        process = np.square(own.noise_sigma[:3])
        return process / (process + (own.gyro_sigma or 0.0) ** 2)

    def _propagate(self, state: Array, control: Array, noise: Array, dt: float) -> None:
        """Covariance of the prediction, by the derivatives of the dynamics: A dx + W dw + P drho + B dx' = 0."""
        window = self.window
        rho = np.split(window.parameters[None], [1, 4, 6], axis=1)
        arguments = (window.present[None], control[None], noise[None], *rho, state[None], dt)
        A, _, W, mass, drag, wind, updraft, B = (block[0] for block in DYNAMICS.jacobian(*arguments))
        moved = -np.linalg.solve(B, np.concatenate([A, mass, drag, wind, updraft, W], axis=1))
        before = self.covariance
        F, G = moved[:, :FIRST_LANDMARK], moved[:, FIRST_LANDMARK:]
        across = F @ before[:FIRST_LANDMARK]
        after = before.copy()
        after[:STATE_SIZE], after[:, :STATE_SIZE] = across, across.T
        own = window.settings
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
        window, settings = self.window, self.window.settings
        noise = np.array([settings.bearing_sigma, settings.range_sigma])
        columns = FIRST_LANDMARK + 2 * used
        forecast, innovation = expected(window.present, self.covariance, window.landmarks[used], columns, noise)
        possible = reading.kinds[own][:, None] == atlas.kinds[used][None]
        found = nearest(sightings, forecast, innovation, possible, self.settings.gates)
        return np.where(found >= 0, used[np.maximum(found, 0)], found)

    def _slot(self) -> int | None:
        """A free slot, if need be that of the landmark not seen for longest; None when the window sees them all."""
        slot = self.atlas.free_slot()
        if slot is not None:
            return slot
        out_of_sight: BoolArray = ~np.any(self.window.seen, axis=0)
        slot = self.atlas.oldest(out_of_sight)
        if slot is None:
            logger.debug("all slots hold landmarks that the window sees: a new one is left out")
            return None
        place = slice(FIRST_LANDMARK + 2 * slot, FIRST_LANDMARK + 2 * slot + 2)
        self.atlas.retire(slot, self.window.landmarks[slot], self.covariance[place, place])
        self.window.forget(slot)
        return slot

    def _look_up(self, slot: int) -> None:
        """Find a new corner on the map."""
        window = self.window
        if self.atlas.kinds[slot] != Landmarks.CORNER or not len(self._survey):
            return
        gaps = np.hypot(*(self._survey - window.landmarks[slot]).T)
        nearest = int(np.argmin(gaps))
        if gaps[nearest] < SAME_CORNER:
            window.survey[slot], window.surveyed[slot] = self._survey[nearest], True


class DeadReckoningEstimator(Estimator):
    """The same sensors without dynamics: see :class:`DeadReckoning`."""

    def __init__(
        self,
        state: Array,
        nominal: quadrotor.Parameters,
        settings: EstimatorSettings | None = None,
        survey: Array | None = None,
    ) -> None:
        """State the graph; arguments as of :class:`Estimator`."""
        super().__init__(state, nominal, settings, survey, DeadReckoning(nominal))


def flyable(packed: Array) -> quadrotor.Parameters:
    """Parameters from an estimate (7,), which may lie where none can: mass is positive, drag not negative."""
    parameters = packed.copy()
    parameters[0] = max(parameters[0], LIGHTEST)
    parameters[1:4] = np.maximum(parameters[1:4], 0.0)
    return quadrotor.Parameters.unpacked(parameters)


assert quadrotor.disturbed_dynamics.kernel is not None
DYNAMICS = quadrotor.disturbed_dynamics.kernel
