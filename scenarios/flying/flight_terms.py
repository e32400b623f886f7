"""The quadrotor's past as terms of a factor graph (Ta et al. 2014, section II-B).

States, process noise, parameters and landmarks are unknowns; the dynamics between consecutive states are hard
constraints; sightings, height and tilt are costs; what has left the window is one joint prior. The terms can stand in
any graph that has the present state and the variables that past and future share: alone, where they are a fixed-lag
smoother, or joined to a control horizon.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import unifg as fg
from unifg.kernels.kernel import Kernel
from unifg.machine.jit import compiled
from unifg.models import landmarks, quadrotor
from unifg.scenarios.flying.arrival import arrival
from unifg.scenarios.flying.flight_window import PLACES, StateWindow, WindowSettings
from unifg.scenarios.horizon.part import Given
from unifg.typing import Array

PAST_TERMS = ("arrival", "noise", "gyro", "dynamics", "sightings", "height", "tilt")
MANIFOLDS = {
    "mass": quadrotor.MASS, "drag": quadrotor.DRAG, "wind": quadrotor.WIND, "updraft": quadrotor.UPDRAFT,
}  # fmt: skip


@compiled
def _turned(v: Array, p: Array, table: Array, r: Array, J: Array) -> None:
    """Noise of the rates less what the gyro saw beyond those commanded."""
    for i in range(3):
        r[i] = v[i] - p[i]
        if len(J):
            for k in range(6):
                J[i, k] = 1.0 if i == k else 0.0


gyro = fg.residual(Kernel(_turned, (quadrotor.NOISE, (3,)), 3, name="gyro", linear=True))
"""``gyro(w, beyond)``: noise of the rates less ``beyond`` (3,), measured less commanded rates [rad/s]."""


class Shared:
    """The unknowns that past and future have in common.

    Attributes:
        mass, drag, wind, updraft: families of one member; fixed to data unless estimated.
        landmarks: family of positions in the ground plane, one per slot.
    """

    def __init__(self, graph: fg.Graph, settings: WindowSettings, parameters: Array) -> None:
        """Add the families to a graph; ``parameters`` (7,) are the defaults of those that are fixed."""
        self._given: dict[str, fg.Data] = {}
        families = {name: graph.variables(name, manifold, 1) for name, manifold in MANIFOLDS.items()}
        for name, family in families.items():
            if name not in settings.estimated:
                self._given[name] = graph.data(f"known {name}", parameters[PLACES[name]])
                graph.fix(family, self._given[name])
        self.mass, self.drag, self.wind, self.updraft = families.values()
        self.landmarks = graph.variables("landmarks", fg.Rn(2), settings.landmarks)

    @property
    def parameters(self) -> tuple[fg.Family, ...]:
        """Mass, drag, wind, updraft: as ``quadrotor.disturbed_dynamics`` takes them."""
        return self.mass, self.drag, self.wind, self.updraft

    def guess(self, window: StateWindow) -> dict[fg.Family, Array]:
        """Present beliefs."""
        guess = {f: window.parameters[None, PLACES[f.name]] for f in self.parameters}
        return {**guess, self.landmarks: window.landmarks}

    def data(self, window: StateWindow) -> dict[fg.Data, Array]:
        """Present values of what is not estimated."""
        return {data: window.parameters[PLACES[name]] for name, data in self._given.items()}


class StateTerms:
    """The window's terms in one graph, and the data that fill them.

    Attributes:
        past: family of past states, oldest first.
        noise: family of process noises; ``noise[k]`` disturbs the step from ``past[k]``.
        present: selection of the present state.
        shared: parameters and landmarks.
        past_terms: names of those that reach the past alone; they are marginalised.
    """

    def __init__(self, graph: fg.Graph, present: fg.Selection, shared: Shared, settings: WindowSettings) -> None:
        """Add everything the past says to a graph."""
        self.present, self.shared = present, shared
        self.past_terms = tuple(n for n in PAST_TERMS if n != "gyro" or settings.gyro_sigma is not None)
        length, count = settings.length, settings.landmarks
        self.past = past = graph.variables("past", quadrotor.STATE, length)
        self.noise = noise = graph.variables("noise", quadrotor.NOISE, length)
        marks = shared.landmarks
        about: tuple[fg.Family | fg.Selection, ...] = (past[0], *shared.parameters, *(marks[k] for k in range(count)))
        size = sum(variable.manifold.dim for variable in about)
        identity = np.concatenate([variable.manifold.identity() for variable in about])
        self._arrival = graph.data("arrival", identity)
        self._information = graph.data("arrival information", np.eye(size))
        self._survey = graph.data("survey", np.zeros((count, 2)), each=True)
        self._surveyed = graph.data("surveyed", np.zeros(count, dtype=bool), each=True)
        sigma = settings.survey_sigma
        # It speaks of landmarks, which stay: it is not marginalised, and is said anew at each tick.
        graph.minimize(fg.prior, marks, self._survey, sigma=sigma, active=self._surveyed, name="survey")
        graph.minimize(arrival(count), *about, self._arrival, information=self._information, name="arrival")
        last = length - 1
        steps, now = (past[:last], past[1:], noise[:last]), (past[last], present, noise[last])
        self._gives = [
            (slice(0, last), _steps(graph, *steps, shared, settings, "")),
            (slice(last, length), _steps(graph, *now, shared, settings, " now")),
            (slice(0, length), _views(graph, past[:], shared, settings, "")),
            (slice(length, length + 1), _views(graph, present, shared, settings, " now")),
        ]

    def data(self, window: StateWindow) -> Given:
        """What the window knows."""
        found: Given = {
            self._arrival: window.arrival[0],
            self._information: window.arrival[1],
            self._survey: window.survey,
            self._surveyed: window.surveyed,
            **self.shared.data(window),
        }
        for at, give in self._gives:
            found |= give(window, at)
        return found

    def guess(self, window: StateWindow) -> dict[fg.Family, Array]:
        """Present beliefs about everything but the present state."""
        return {self.past: window.states[:-1], self.noise: window.noises, **self.shared.guess(window)}

    def accept(self, window: StateWindow, solution: fg.Solution) -> None:
        """Take the estimate from a solution, and marginalise the oldest state, which leaves at the next move."""
        window.states[:-1], window.states[-1] = solution[self.past], solution[self.present][0]
        window.noises[:] = solution[self.noise]
        window.landmarks[:] = solution[self.shared.landmarks]
        for family in self.shared.parameters:
            window.parameters[PLACES[family.name]] = solution[family][0]
        kept: list[fg.Family | fg.Selection] = [self.past[1], *self.shared.parameters, self.shared.landmarks]
        reference, information = solution.marginal_prior(self.past_terms, [self.past[0], self.noise[0]], kept)
        window.depart(window.stacked(1), reference[0], information)


def _steps(
    graph: fg.Graph,
    start: fg.Selection,
    end: fg.Selection,
    noise: fg.Selection,
    shared: Shared,
    settings: WindowSettings,
    suffix: str,
) -> Callable[[StateWindow, slice], Given]:
    """Noise, gyro and dynamics of some steps."""
    n = len(start)
    controls = graph.data(f"controls{suffix}", np.zeros((n, 4)), each=True)
    durations = graph.data(f"durations{suffix}", np.zeros(n), each=True)
    turned = graph.data(f"turned{suffix}", np.zeros((n, 3)), each=True)
    graph.minimize(fg.prior, noise, np.zeros(6), sigma=settings.noise_sigma, name=f"noise{suffix}")
    if settings.gyro_sigma is not None:
        graph.minimize(gyro, noise, turned, sigma=settings.gyro_sigma, name=f"gyro{suffix}")
    motion = (start, controls, noise, *shared.parameters, end, durations)
    graph.constrain(quadrotor.disturbed_dynamics, *motion, lower=0.0, upper=0.0, name=f"dynamics{suffix}")
    return lambda window, at: {
        controls: window.controls[at], durations: window.durations[at], turned: window.turned[at],
    }  # fmt: skip


def _views(
    graph: fg.Graph, states: fg.Selection, shared: Shared, settings: WindowSettings, suffix: str
) -> Callable[[StateWindow, slice], Given]:
    """What was measured at some states."""
    n, count = len(states), settings.landmarks
    sightings = graph.data(f"sightings{suffix}", np.ones((n * count, 2)), each=True)
    seen = graph.data(f"seen{suffix}", np.zeros(n * count, dtype=bool), each=True)
    heights = graph.data(f"heights{suffix}", np.zeros(n), each=True)
    tilts = graph.data(f"tilts{suffix}", np.zeros((n, 3)), each=True)
    measured = graph.data(f"measured{suffix}", np.zeros(n, dtype=bool), each=True)
    pairs = (
        states[np.repeat(np.arange(n), count)] if n > 1 else states,
        shared.landmarks[np.tile(np.arange(count), n)],
        sightings,
    )
    sigma = [settings.bearing_sigma, settings.range_sigma]
    graph.minimize(landmarks.bearing_range, *pairs, sigma=sigma, active=seen, name=f"sightings{suffix}")
    graph.minimize(
        landmarks.height, states.p, heights, sigma=settings.height_sigma, name=f"height{suffix}", active=measured
    )
    graph.minimize(landmarks.tilt, states.R, tilts, sigma=settings.tilt_sigma, name=f"tilt{suffix}", active=measured)
    return lambda window, at: {
        sightings: window.sightings[at].reshape(-1, 2), seen: window.seen[at].ravel(), heights: window.heights[at],
        tilts: window.tilts[at], measured: window.measured[at],
    }  # fmt: skip
