"""The quadrotor's past: what was done and measured at the last ticks, as terms (Ta et al. 2014, section II-B).

States, process noise, parameters and landmarks are unknowns; the dynamics between consecutive states are hard
constraints; sightings, height and tilt are costs; what has left the window is one joint prior. Before the window has
filled up, steps of no duration lead to the start: their dynamics say that nothing moved; the structure never changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.factors.residuals import Residual
from unifg.horizon import Constant, Context, Measurement, Robot, Term, Window
from unifg.models import landmarks, quadrotor
from unifg.models.inertial import specific_force
from unifg.scenarios.options import AtLeastOne, AtLeastTwo, Positive, Settings
from unifg.scenarios.quadrotor.arrival import arrival, seen_from_the_vehicle
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.typing import Array, ArrayLike, BoolArray

STATE_SIZE, PARAMETER_SIZE = 9, 7  # of the tangents
HELD = 1.0  # [m] standard deviation of a slot without a landmark; of no consequence
UNKNOWN = 1e3  # [m] of a landmark that nothing but its sightings says anything about
PLACES = {"mass": slice(0, 1), "drag": slice(1, 4), "wind": slice(4, 6), "updraft": slice(6, 7)}
MANIFOLDS = {
    "mass": quadrotor.MASS, "drag": quadrotor.DRAG, "wind": quadrotor.WIND, "updraft": quadrotor.UPDRAFT,
}  # fmt: skip


@dataclass(frozen=True)
class WindowSettings(Settings):
    """Sizes and standard deviations.

    Attributes:
        length: past states kept, at least two.
        landmarks: slots for landmarks.
        estimated: which of mass, drag, wind and updraft are unknown; mass and updraft together are not observable at
            hover.
        noise_sigma: (6,) process noise, rates [rad/s] and accelerations [m/s^2], held over a tick.
        bearing_sigma, range_sigma: of a sighting [rad, m].
        height_sigma: [m].
        tilt_sigma: of each component of the measured R' e3.
        gyro_sigma: [rad/s]; None when the gyro's rates take the place of the commanded ones.
        force_sigma: of the specific force felt over a tick [m/s^2]; None without an accelerometer.
        survey_sigma: of each coordinate of a landmark that is on the map from the start [m].

    Raises:
        ScenarioError: on a window that is too short, no slot, or an unknown parameter.
    """

    length: AtLeastTwo = 20
    landmarks: AtLeastOne = 16
    estimated: tuple[str, ...] = ("mass", "drag", "wind")
    noise_sigma: Positive[tuple[float, ...]] = tuple(DisturbanceModel().white_sigma(0.05).tolist())
    bearing_sigma: Positive[float] = 0.01
    range_sigma: Positive[float] = 0.05
    height_sigma: Positive[float] = 0.03
    tilt_sigma: Positive[float] = 0.01
    gyro_sigma: Positive[float] | None = 0.01
    force_sigma: Positive[float] | None = None
    survey_sigma: Positive[float] = 0.02

    def __post_init__(self) -> None:
        """Refuse what cannot be a window."""
        super().__post_init__()
        for name in self.estimated:
            if name not in PLACES:
                raise fg.ScenarioError(f"'{name}' is no parameter of a quadrotor: choose from {', '.join(PLACES)}")

    def free(self) -> BoolArray:
        """(7,) which parameters are estimated."""
        mask = np.zeros(PARAMETER_SIZE, dtype=bool)
        for name in self.estimated:
            mask[PLACES[name]] = True
        return mask


FORCE = specific_force(quadrotor.STATE)


def gyro(noise: Array, beyond: Array) -> Array:
    """(n, 3) noise (n, 6) of the rates less ``beyond`` (n, 3), measured less commanded rates [rad/s]."""
    return noise[:, :3] - beyond


class SeenFromTheVehicle:
    """Coordinates of the prior about what has left: see :mod:`unifg.scenarios.quadrotor.arrival`."""

    def __init__(self, slots: int) -> None:
        """For so many slots of landmarks."""
        self._slots = slots

    def residual(self, *manifolds: fg.Manifold) -> Residual:
        """Of state, parameters and landmarks."""
        return arrival(self._slots)

    def more(self, dim: int) -> int:
        """The offset of the lowest point."""
        return dim

    def express(self, here: Array, step: Array, lowest: Array, information: Array) -> tuple[Array, Array]:
        """As seen from the vehicle."""
        return seen_from_the_vehicle(here, step, information)


@dataclass(frozen=True)
class Motion:
    """Noise, gyro and dynamics of the steps."""

    settings: WindowSettings

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """The gyro's rates since the last node, less those commanded [rad/s]; what pushed meanwhile [m/s^2]."""
        return {"turned": (3,), "push": (2,)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add them."""
        s, noise, steps = self.settings, graph.families["noise"], len(x) - 1
        durations = graph.data("durations", np.zeros(steps), each=True)
        pushed = graph.data("pushed", np.zeros((steps, 6)), each=True)
        graph.minimize(fg.prior, noise, pushed, sigma=s.noise_sigma, name="noise")
        if s.gyro_sigma is not None:
            turned = graph.data("turned", np.zeros((steps, 3)), each=True)
            graph.minimize(gyro, noise, turned, sigma=s.gyro_sigma, name="gyro")
        motion = (x[:-1], u, noise, *parameters_in(graph), x[1:], durations)
        graph.constrain(quadrotor.disturbed_dynamics, *motion, lower=0.0, upper=0.0, name="dynamics")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Lengths of the steps, pushes, and rates of the gyroscope."""
        pushed = np.zeros((len(now.past.times) - 1, 6))
        pushed[:, 3:5] = now.past.recorded("push")[0][1:]
        found: dict[str, ArrayLike] = {"durations": np.diff(now.past.times), "pushed": pushed}
        if self.settings.gyro_sigma is not None:
            found["turned"] = now.past.recorded("turned")[0][1:]
        return found


@dataclass(frozen=True)
class Accelerometer:
    """Specific force between neighbours; it ties their velocities to each other, whatever moves the vehicle."""

    sigma: float

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """Mean specific force since the last node [m/s^2]."""
        return {"force": (3,)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add a cost for every step."""
        steps = len(x) - 1
        force = graph.data("force", np.zeros((steps, 3)), each=True)
        per_second = graph.data("per second", np.ones(steps), each=True)
        felt = graph.data("felt", np.zeros(steps, dtype=bool), each=True)
        sides = x[:-1], x[1:], force, per_second
        graph.minimize(FORCE, *sides, sigma=self.sigma, active=felt, name="accelerometer")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Specific force in steps that took time."""
        durations = np.diff(now.past.times)
        felt = durations > 0.0
        per_second = 1.0 / np.where(felt, durations, 1.0)
        return {"force": now.past.recorded("force")[0][1:], "per second": per_second, "felt": felt}


@dataclass(frozen=True)
class LandmarkSightings:
    """Bearings and ranges of the landmarks' slots."""

    settings: WindowSettings

    @property
    def records(self) -> Mapping[str, tuple[int, ...]]:
        """Bearing [rad] and range [m] of every slot, and whether it was seen."""
        return {"sightings": (self.settings.landmarks, 3)}

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add a cost for every node and slot."""
        s, n, count = self.settings, len(x), self.settings.landmarks
        measured = graph.data("sightings", np.ones((n * count, 2)), each=True)
        seen = graph.data("seen", np.zeros(n * count, dtype=bool), each=True)
        marks = graph.families["landmarks"][np.tile(np.arange(count), n)]
        pairs = x[np.repeat(np.arange(n), count)], marks, measured
        sigma = [s.bearing_sigma, s.range_sigma]
        graph.minimize(landmarks.bearing_range, *pairs, sigma=sigma, active=seen, name="sightings")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """LandmarkSightings."""
        rows = now.past.recorded("sightings")[0].reshape(-1, 3)
        seen = rows[:, 2] > 0.0
        return {"sightings": np.where(seen[:, None], rows[:, :2], 1.0), "seen": seen}


class Survey:
    """Landmarks that are on the map from the start. It speaks of what stays: it is said anew at each tick.

    Attributes:
        places: (K, 2) where the map has them [m].
        known: (K,) which of the slots hold such landmarks.
    """

    def __init__(self, settings: WindowSettings) -> None:
        """Begin with none."""
        self._sigma = settings.survey_sigma
        self.places, self.known = np.zeros((settings.landmarks, 2)), np.zeros(settings.landmarks, dtype=bool)

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add a cost for every slot."""
        places = graph.data("survey", np.zeros_like(self.places), each=True)
        known = graph.data("surveyed", np.zeros_like(self.known), each=True)
        graph.minimize(fg.prior, graph.families["landmarks"], places, sigma=self._sigma, active=known, name="survey")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        """Corners on the map."""
        return {"survey": self.places, "surveyed": self.known}


def parameters_in(graph: fg.Graph) -> tuple[fg.Family, ...]:
    """Mass, drag, wind, updraft: as ``quadrotor.disturbed_dynamics`` takes them."""
    return tuple(graph.families[name] for name in MANIFOLDS)


def robot(settings: WindowSettings, state: Array, parameters: Array, sigma: Array) -> Robot:
    """The vehicle, what past and future share, and the noise of a step.

    Args:
        settings: of the window.
        state: (10,) believed at the start; idle slots wait near it.
        parameters: (7,) believed.
        sigma: (7,) their standard deviations; what is not estimated is taken as it is.
    """
    free = settings.free()
    constants = [
        Constant(name, kind, parameters[PLACES[name]], sigma[PLACES[name]] * free[PLACES[name]])
        for name, kind in MANIFOLDS.items()
    ]
    places = state[:2] + np.tile([5.0, 0.0], (settings.landmarks, 1))
    constants.append(Constant("landmarks", fg.Rn(2), places, HELD))
    return Robot(quadrotor.STATE, quadrotor.CONTROL, tuple(constants), {"noise": quadrotor.NOISE})


def window(
    settings: WindowSettings, robot: Robot, survey: Survey, state: Array, sigma: Array, solver: fg.Solver
) -> Window:
    """A window that begins at a state (10,), believed with standard deviations (9,)."""
    terms: list[Term] = [
        survey,
        Motion(settings),
        LandmarkSightings(settings),
        Measurement("height", landmarks.height, (), settings.height_sigma, component="p"),
        Measurement("tilt", landmarks.tilt, (3,), settings.tilt_sigma, component="R"),
    ]
    if settings.force_sigma is not None:
        terms.append(Accelerometer(settings.force_sigma))
    return Window(
        robot, settings.length, terms, start=state, sigma=sigma, solver=solver,
        arrival=SeenFromTheVehicle(settings.landmarks), filled=True,
    )  # fmt: skip


def packed(constants: Mapping[str, Array]) -> Array:
    """(7,) parameters."""
    return np.concatenate([constants[name][0] for name in MANIFOLDS])
