"""Mass and drag from the change of the velocity (FactorMPC, reference 29).

Over a stretch of the past, thrust and attitude are known from what was told and seen. The mean of v' is

    (v_1 - v_0) / t = (1/m) (mean of T R e3 - mean of R diag(R' v) drag) - g e3

one residual of mass and drag for each stretch, whose standard deviation is that of two velocities. These terms stand
in the graph of the plan, or alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.scenarios.options import AtLeastOne, Positive, Settings
from unifg.solvers import GaussNewton
from unifg.typing import Array

__all__ = ["Weighing", "WeighingSettings"]


@dataclass(frozen=True)
class WeighingSettings(Settings):
    """Numbers of the estimate.

    Attributes:
        stretch: length of a stretch of the past, whole ticks [s].
        count: stretches that are remembered.
        velocity_sigma: standard deviation of a velocity seen [m/s].
        mass_sigma: of the mass before anything was seen, relative.
        drag_sigma: of the drag before anything was seen [kg/s].
        least: least mass that is believed [kg].
    """

    stretch: Positive[float] = 0.05
    count: AtLeastOne = 60
    velocity_sigma: Positive[float] = 0.01
    mass_sigma: Positive[float] = 0.1
    drag_sigma: Positive[float] = 0.2
    least: Positive[float] = 0.2


def balance(mass: Array, drag: Array, push: Array, hold: Array, gained: Array) -> Array:
    """(n, 3) acceleration that force and mass explain, less the one seen [m/s^2].

    Args:
        mass: (n, 1) [kg].
        drag: (n, 3) [kg/s].
        push: (n, 3) mean force of the rotors in the world [N].
        hold: (n, 3, 3) mean of R diag(R' v): times the drag, the force of the air [m/s].
        gained: (n, 3) mean acceleration, with that of gravity taken away [m/s^2].
    """
    return (push - (hold @ drag[:, :, None])[:, :, 0]) / mass - gained


class Weighing:
    """Remembers stretches of the past.

    Attributes:
        settings: the numbers.
        believed: parameters by the past alone.
    """

    def __init__(self, settings: WeighingSettings, nominal: quadrotor.Parameters, dt: float) -> None:
        """Begin with what is believed before anything was seen; ``dt`` is the length of a tick [s]."""
        self.settings, self.believed, self._nominal, self._dt = settings, nominal, nominal, dt
        n = settings.count
        self._push, self._hold, self._gained = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3))
        self._known = np.zeros(n, dtype=bool)
        self._at = 0
        self._begun: Array | None = None
        self._sums = np.zeros((3, 4))
        graph = fg.Graph()
        self._mass, self._drag = graph.variables("mass", quadrotor.MASS, 1), graph.variables("drag", quadrotor.DRAG, 1)
        self._handles = self.state(graph, self._mass, self._drag)
        self._alone = GaussNewton(tolerance=1e-8).prepare(graph)

    def state(self, graph: fg.Graph, mass: fg.Family, drag: fg.Family) -> dict[str, fg.Data]:
        """Add the costs of mass and drag by the past to a graph; returns its data by name."""
        s, n = self.settings, self.settings.count
        handles = {name: graph.data(name, value, each=True) for name, value in self.data().items()}
        *motion, known = handles.values()
        sigma = 2.0**0.5 * s.velocity_sigma / s.stretch
        every = np.zeros(n, dtype=np.intp)
        graph.minimize(balance, mass[every], drag[every], *motion, sigma=sigma, active=known, name="weighing")
        nominal = self._nominal
        graph.minimize(fg.prior, mass, [nominal.mass], sigma=s.mass_sigma * nominal.mass, name="mass before")
        graph.minimize(fg.prior, drag, np.array(nominal.drag), sigma=s.drag_sigma, name="drag before")
        return handles

    def data(self) -> dict[str, Array]:
        """Values of the data by name."""
        return {"push": self._push, "hold": self._hold, "gained": self._gained, "weighed": self._known}

    def see(self, state: Array, thrust: float) -> None:
        """Remember a tick.

        Args:
            state: (10,) as it is seen.
            thrust: as it must be by now, by what was told [N].
        """
        turn = SO3.to_matrix(state[3:7])
        self._sums[:, 0] += thrust * turn[:, 2]
        self._sums[:, 1:] += turn * (turn.T @ state[7:])
        if self._begun is None:
            self._begun, self._count = state[7:].copy(), 0
            self._sums *= 0.5
            return
        self._count += 1
        if self._count < round(self.settings.stretch / self._dt):
            return
        half = 0.5 * np.column_stack([thrust * turn[:, 2], turn * (turn.T @ state[7:])])
        mean = (self._sums - half) / self._count
        k = self._at % self.settings.count
        self._push[k], self._hold[k] = mean[:, 0], mean[:, 1:]
        self._gained[k] = (state[7:] - self._begun) / (self._count * self._dt)
        self._gained[k, 2] += quadrotor.GRAVITY
        self._known[k] = True
        self._at += 1
        self._begun, self._count, self._sums = state[7:].copy(), 0, half
        self._weigh()

    def _weigh(self) -> None:
        p = self.believed
        given = {self._handles[name]: value for name, value in self.data().items()}
        solution = self._alone.solve({self._mass: [[p.mass]], self._drag: [p.drag]}, data=given)
        mass = max(float(solution[self._mass][0, 0]), self.settings.least)
        drag = np.maximum(solution[self._drag][0], 0.0).tolist()
        self.believed = quadrotor.Parameters(mass, (drag[0], drag[1], drag[2]), p.wind, p.updraft)
