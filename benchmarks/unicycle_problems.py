"""Sixteen optimal control problems of a unicycle with known optima; :mod:`benchmarks.reference_problems` solves them.

The listed optima were found by IPOPT 3.14 at tolerance 1e-9 from the same guess.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from unifg.models import unicycle
from unifg.typing import Array

DT = 0.1  # [s]
LIMIT = 1.0  # [m/s] and [rad/s]
STAGE, TERMINAL, EFFORT = np.array([10.0, 10.0, 1.0]), np.array([50.0, 50.0, 5.0]), np.array([0.1, 0.1])
HORIZONS = (20, 50)
STARTS = {
    "straight": (0.0, 0.5, -0.4),
    "curve": (0.0, -0.4, 0.6),
    "ahead": (0.0, 0.0, 0.0),
    "behind": (0.0, 0.0, 0.3),
}
RING = ((0.6, 2.2), (1.3, 1.8), (2.2, 2.2), (3.2, 1.8), (4.2, 2.2))  # angle [rad] and distance [m] from (0, 2)
DISCS = {  # x, y, radius [m]
    "straight": ((1.6, -0.15, 0.4), (3.0, 0.25, 0.45), (5.0, -0.2, 0.5), (6.6, 0.3, 0.4), (8.2, -0.25, 0.4)),
    "curve": tuple((d * np.sin(a), 2.0 - d * np.cos(a), 0.35) for a, d in RING),
    "ahead": ((1.2, 0.55, 0.4), (2.1, 0.4, 0.35), (0.6, -0.5, 0.3), (3.6, 1.5, 0.3), (2.0, 1.6, 0.3)),
    "behind": ((-1.0, 0.25, 0.3), (-1.9, -0.2, 0.3), (0.7, 0.6, 0.3), (-0.4, -0.8, 0.3), (-3.0, 0.15, 0.3)),
}
# (instance, with discs, N): known local optima, the one reached by IPOPT from the cold guess first.
OPTIMA: dict[tuple[str, bool, int], tuple[float, ...]] = {
    ("straight", False, 20): (6.40874,),
    ("straight", False, 50): (6.40879,),
    ("straight", True, 20): (9.56973,),
    ("straight", True, 50): (12.98617,),
    ("curve", False, 20): (3.74998,),
    ("curve", False, 50): (3.74998,),
    ("curve", True, 20): (5.32781, 5.33182),
    ("curve", True, 50): (6.91008,),
    ("ahead", False, 20): (561.41452,),
    ("ahead", False, 50): (558.59179,),
    ("ahead", True, 20): (579.75063,),
    ("ahead", True, 50): (608.83744,),
    ("behind", False, 20): (54.47372,),
    ("behind", False, 50): (59.47520,),
    ("behind", True, 20): (54.47522,),
    ("behind", True, 50): (63.46789, 63.46577, 79.43),
}


@dataclass(frozen=True)
class Problem:
    """The numbers of one problem.

    Attributes:
        instance: name.
        blocked: whether the discs are there.
        horizon: N.
        dt: sampling time [s].
        limit: of both controls [m/s, rad/s].
    """

    dt: ClassVar[float] = DT
    limit: ClassVar[float] = LIMIT

    instance: str
    blocked: bool
    horizon: int

    @property
    def name(self) -> str:
        """For the tables."""
        return f"{self.instance}{', discs' if self.blocked else ''}, N = {self.horizon}"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    @property
    def discs(self) -> Array:
        """(M, 3) x, y, radius [m]."""
        return np.array(DISCS[self.instance] if self.blocked else np.zeros((0, 3)), dtype=np.float64)

    @property
    def start(self) -> Array:
        """(3,) first pose."""
        return np.array(STARTS[self.instance])

    @property
    def weights(self) -> tuple[Array, Array]:
        """Of the states (N + 1, 3) and of a control (2,)."""
        return np.vstack([np.tile(STAGE, (self.horizon, 1)), TERMINAL]), EFFORT

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 3) from step ``first`` on, headings not wrapped, and controls (N, 2)."""
        t = DT * np.arange(first, first + self.horizon + 1)
        zero = np.zeros_like(t)
        states, control = {
            "straight": ((0.8 * t, zero, zero), (0.8, 0.0)),
            "curve": ((2.0 * np.sin(0.35 * t), 2.0 - 2.0 * np.cos(0.35 * t), 0.35 * t), (0.7, 0.35)),
            "ahead": ((zero + 3.0, zero + 1.0, zero), (0.0, 0.0)),
            "behind": ((-0.5 * t, zero, zero + np.pi), (0.5, 0.0)),
        }[self.instance]
        return np.column_stack(states), np.tile(control, (self.horizon, 1))

    def guess(self) -> tuple[Array, Array]:
        """The reference itself, even through the discs; ``ahead`` has none and begins with the robot at rest."""
        states, controls = self.reference()
        if self.instance == "ahead":
            states[:] = STARTS["ahead"]
        states[0] = STARTS[self.instance]
        return states, controls

    def plant(self, pose: Array, control: Array, index: int) -> Array:
        """(3,) pose after closed-loop step ``index``, heading not wrapped; disturbed only where no disc can be hit."""
        moved = unicycle.step(pose[None], control[None], DT)[0]
        moved[2] = pose[2] + DT * control[1]
        push = 0.01 * np.array([np.sin(1.7 * index), np.cos(2.3 * index), np.sin(3.1 * index)])
        return np.asarray(moved if self.blocked else moved + push)

    def stage_cost(self, pose: Array, control: Array, index: int) -> float:
        """Cost of one step of the closed loop."""
        states, controls = self.reference(index)
        return float(0.5 * STAGE @ (pose - states[0]) ** 2 + 0.5 * EFFORT @ (control - controls[0]) ** 2)


def problems() -> list[Problem]:
    """All sixteen."""
    return [Problem(*numbers) for numbers in itertools.product(STARTS, (False, True), HORIZONS)]
