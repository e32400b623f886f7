"""Conditions of one flight through the corridor, true and believed, drawn by seed.

Streams of their own for truth and belief, besides those of the layout and of the world's noise: flights of one seed
meet the same cylinders, mass, drag, wind, disturbances and sensor noise, however they are estimated and controlled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unifg.models import quadrotor
from unifg.scenarios.simulation.layouts import Layout, corridor
from unifg.typing import Array

__all__ = ["DRAG", "MASS", "WIND", "Conditions", "draw_conditions"]

MASS = 1.0
"""True mass [kg]."""

DRAG = (0.1, 0.3)
"""Between these each coefficient is drawn [kg/s]; their middle is believed."""

WIND = 0.8
"""Greatest strength of the steady wind, an acceleration [m/s^2]; no wind is believed."""

_TAG = 54  # keeps the streams apart from those of layouts and world


@dataclass(frozen=True)
class Conditions:
    """Truth and belief at the start.

    Attributes:
        layout: what stands.
        true: parameters of the vehicle.
        nominal: parameters believed at the start.
        deviation: (9,) standard normal numbers; times the believed sigmas they are the error of the state believed at
            the start, a right perturbation of the truth.
    """

    layout: Layout
    true: quadrotor.Parameters
    nominal: quadrotor.Parameters
    deviation: Array


def draw_conditions(seed: int, mass_error: float = 0.05) -> Conditions:
    """The conditions of one seed.

    The mass is believed wrong by ``mass_error`` of the truth, too heavy or too light with equal chance. Drag
    coefficients are uniform in `DRAG`. The wind's direction is uniform, its strength uniform up to `WIND`.

    Args:
        seed: not negative.
        mass_error: relative, in [0, 1).
    """
    truth, belief = np.random.default_rng([_TAG, seed]).spawn(2)
    drag = truth.uniform(*DRAG, 3).tolist()
    angle, strength = truth.uniform(0.0, 2.0 * math.pi), truth.uniform(0.0, WIND)
    wind = (strength * math.cos(angle), strength * math.sin(angle))
    sign = 1.0 if belief.random() < 0.5 else -1.0
    middle = 0.5 * sum(DRAG)
    return Conditions(
        layout=corridor(seed),
        true=quadrotor.Parameters(MASS, (drag[0], drag[1], drag[2]), wind),
        nominal=quadrotor.Parameters(MASS * (1.0 + sign * mass_error), (middle, middle, middle)),
        deviation=belief.standard_normal(9),
    )
