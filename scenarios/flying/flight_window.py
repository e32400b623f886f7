"""The quadrotor's past as numbers: what was done and measured at the last ticks, and what is believed about it.

How it becomes a factor graph is stated in :mod:`unifg.scenarios.flying.flight_terms`. A slot that no state has
entered yet lasts zero seconds: its dynamics say that it equals the next one, so that the structure never changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.scenarios.flying.arrival import seen_from_the_vehicle
from unifg.scenarios.horizon.past import Window
from unifg.scenarios.worlds.disturbance import DisturbanceModel
from unifg.typing import Array, BoolArray, IntArray

STATE_SIZE, PARAMETER_SIZE = 9, 7  # of the tangents
HELD = 1.0  # information of a slot without a landmark; of no consequence
FIXED = 1e-9  # of a parameter that is not estimated
UNKNOWN = 1e-6  # [1/m^2] about a landmark that nothing but its sightings says anything about
PLACES = {"mass": slice(0, 1), "drag": slice(1, 4), "wind": slice(4, 6), "updraft": slice(6, 7)}


@dataclass(frozen=True)
class WindowSettings:
    """Sizes and standard deviations.

    Attributes:
        length: past states kept.
        landmarks: slots for landmarks.
        estimated: which of mass, drag, wind and updraft are unknown; mass and updraft together are not observable at
            hover.
        noise_sigma: (6,) process noise, rates [rad/s] and accelerations [m/s^2], held over a tick.
        bearing_sigma, range_sigma: of a sighting [rad, m].
        height_sigma: [m].
        tilt_sigma: of each component of the measured R' e3.
        gyro_sigma: [rad/s]; None when the gyro's rates take the place of the commanded ones.
        survey_sigma: of each coordinate of a landmark that is on the map from the start [m].

    Raises:
        ScenarioError: on a window that is too short, no slot, or an unknown parameter.
    """

    length: int = 20
    landmarks: int = 16
    estimated: tuple[str, ...] = ("mass", "drag", "wind")
    noise_sigma: tuple[float, ...] = tuple(DisturbanceModel().white_sigma(0.05).tolist())
    bearing_sigma: float = 0.01
    range_sigma: float = 0.05
    height_sigma: float = 0.03
    tilt_sigma: float = 0.01
    gyro_sigma: float | None = 0.01
    survey_sigma: float = 0.02

    def __post_init__(self) -> None:
        """Refuse what cannot be a window."""
        if self.length < 2:
            raise fg.ScenarioError(f"a window needs at least two past states, found {self.length}")
        if self.landmarks < 1:
            raise fg.ScenarioError(f"a window needs at least one slot for landmarks, found {self.landmarks}")
        for name in self.estimated:
            if name not in PLACES:
                raise fg.ScenarioError(f"'{name}' is no parameter of a quadrotor: choose from {', '.join(PLACES)}")

    def free(self) -> BoolArray:
        """(7,) which parameters are estimated."""
        mask = np.zeros(PARAMETER_SIZE, dtype=bool)
        for name in self.estimated:
            mask[PLACES[name]] = True
        return mask


class StateWindow(Window):
    """The last L states, oldest first, then the present one, and what they saw of K landmarks.

    Attributes:
        settings: sizes and standard deviations.
        states: (L + 1, 10).
        noises: (L, 6) process noise of each step.
        controls: (L, 4) applied from one state to the next.
        durations: (L,) of the steps [s]; zero before the window has filled up.
        turned: (L, 3) gyro's rates less those commanded [rad/s].
        heights: (L + 1,), ``tilts``: (L + 1, 3), and ``measured`` (L + 1,) whether they were.
        sightings: (L + 1, K, 2) bearing and range, and ``seen`` (L + 1, K) whether they happened.
        parameters: (7,) mass, drag, wind, updraft.
        landmarks: (K, 2) positions; ``used`` (K,) which of them are landmarks.
        survey: (K, 2) where the map has them; ``surveyed`` (K,) which of them are on it.
        arrival: reference (S,) and information (D, D) of the prior on the oldest state, the parameters and landmarks,
            as :mod:`unifg.scenarios.flying.arrival` has them.
    """

    def __init__(
        self, settings: WindowSettings, state: Array, covariance: Array, parameters: Array, sigma: Array
    ) -> None:
        """Begin with the present alone.

        Args:
            settings: sizes and standard deviations.
            state: (10,) believed.
            covariance: (9, 9) of its right perturbation.
            parameters: (7,) believed.
            sigma: (7,) their standard deviations; what is not estimated is taken as it is.
        """
        length, count = settings.length, settings.landmarks
        super().__init__(length, entered=length)  # by states that lasted no time
        self.settings = settings
        self.states = np.tile(np.asarray(state, dtype=np.float64), (length + 1, 1))
        self.noises, self.controls, self.durations = np.zeros((length, 6)), np.zeros((length, 4)), np.zeros(length)
        self.turned = np.zeros((length, 3))
        self.heights, self.tilts = np.zeros(length + 1), np.zeros((length + 1, 3))
        self.measured = np.zeros(length + 1, dtype=bool)
        self.sightings = np.ones((length + 1, count, 2))
        self.seen = np.zeros((length + 1, count), dtype=bool)
        self.parameters = np.asarray(parameters, dtype=np.float64).copy()
        self.landmarks = self.states[0, :2] + np.tile([5.0, 0.0], (count, 1))
        self.used = np.zeros(count, dtype=bool)
        self.survey, self.surveyed = np.zeros((count, 2)), np.zeros(count, dtype=bool)
        information = np.zeros((STATE_SIZE + PARAMETER_SIZE + 2 * count,) * 2)
        information[:STATE_SIZE, :STATE_SIZE] = np.linalg.inv(covariance)
        own = np.arange(STATE_SIZE, STATE_SIZE + PARAMETER_SIZE)
        information[own, own] = 1.0 / np.where(settings.free(), sigma, 1.0) ** 2
        start = self.stacked(0)
        self.depart(start, start, information)
        self.arrival = self.departure

    @property
    def present(self) -> Array:
        """(10,) believed state."""
        state: Array = self.states[-1]
        return state

    def move(self, control: Array, dt: float, state: Array, noise: Array, turned: Array) -> None:
        """Let the oldest state leave, and begin a new present at the predicted ``state`` (10,).

        Args:
            control: (4,) applied since the last tick.
            dt: [s].
            state: (10,) where that should lead.
            noise: (6,) with which it does.
            turned: (3,) gyro's rates since then, less those commanded [rad/s].
        """
        self.shift(
            self.states, self.noises, self.controls, self.durations, self.turned, self.heights, self.tilts,
            self.measured, self.sightings, self.seen,
        )  # fmt: skip
        self.states[-1], self.controls[-1], self.durations[-1] = state, control, dt
        self.noises[-1], self.turned[-1] = noise, turned
        self.measured[-1], self.seen[-1] = False, False

    def measure(self, height: float, tilt: Array) -> None:
        """Attach height [m] and tilt (3,), R' e3, to the present."""
        self.heights[-1], self.tilts[-1], self.measured[-1] = height, tilt, True

    def sight(self, slot: int, bearing: float, distance: float) -> None:
        """Attach a sighting of a landmark to the present."""
        self.sightings[-1, slot], self.seen[-1, slot] = (bearing, distance), True

    def stacked(self, k: int) -> Array:
        """(S,) state ``k``, parameters and landmarks as they are believed now, side by side."""
        return np.concatenate([self.states[k], self.parameters, self.landmarks.ravel()])

    def depart(self, here: Array, reference: Array, information: Array) -> None:
        """Set the prior that stands for the oldest state once it has left.

        Args:
            here: (S,) where it is frozen.
            reference: (S,) its lowest point.
            information: (D, D) over right perturbations; slots without a landmark and parameters that are not
                estimated may have none.
        """
        idle = STATE_SIZE + PARAMETER_SIZE + np.flatnonzero(np.repeat(~self.used, 2))
        reference, information = seen_from_the_vehicle(here, reference, without(information, idle))
        information[idle, idle] = HELD
        given = STATE_SIZE + np.flatnonzero(~self.settings.free())
        information[given], information[:, given] = 0.0, 0.0
        information[given, given] = FIXED
        self.departure = reference, information

    def admit(self, slot: int, position: Array) -> None:
        """Begin a landmark at ``position`` (2,), about which nothing but its sightings says anything."""
        self.landmarks[slot], self.used[slot] = position, True
        reference, information = self.arrival
        own = self._columns(slot)
        reference, information = reference.copy(), information.copy()
        reference[own + 1] = position  # the state's storage is one longer than its tangent
        information[own], information[:, own] = 0.0, 0.0
        information[own, own] = UNKNOWN
        self.arrival = self.departure = reference, information

    def forget(self, slot: int) -> None:
        """Give up a landmark: the arrival's prior is marginalised, its sightings in the window do not count."""
        reference, information = self.arrival
        own = self._columns(slot)
        kept = without(information, own)
        kept[own, own] = HELD
        self.arrival = self.departure = reference, kept
        self.used[slot], self.surveyed[slot], self.seen[:, slot] = False, False, False

    @staticmethod
    def _columns(slot: int) -> IntArray:
        """Tangent columns of a landmark in the joint prior."""
        first = STATE_SIZE + PARAMETER_SIZE + 2 * slot
        return np.array([first, first + 1])


def without(information: Array, columns: IntArray) -> Array:
    """Information (D, D) once some columns are marginalised: theirs are zero."""
    kept = information.copy()
    kept[columns], kept[:, columns] = 0.0, 0.0
    known = columns[information[columns, columns] > 0.0]
    if len(known):
        across = information[:, known]
        across[columns] = 0.0
        lost = across @ np.linalg.solve(information[np.ix_(known, known)], across.T)
        kept -= 0.5 * (lost + lost.T)
    return kept
