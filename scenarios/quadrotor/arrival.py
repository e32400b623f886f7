"""The prior about what has left the window, in coordinates that turn with the vehicle.

Where the world's origin is and which way it faces, landmarks seen from a vehicle cannot tell. A prior linearised in
the world's coordinates forgets that as soon as its heading is corrected: it claims to know the heading better than it
does, and holds on to the wrong one (Huang, Mourikis and Roumeliotis, Int. J. Robotics Research 29 (2010), on
inconsistent SLAM). Here velocity, wind and landmarks are those seen from the vehicle's place and heading, and attitude
is heading and tilt: a turn of everything changes the heading and nothing else, a shift of everything the position.
"""

from __future__ import annotations

from functools import cache

import numpy as np

import unifg as fg
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual
from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.typing import Array

PARTS = (quadrotor.STATE, quadrotor.MASS, quadrotor.DRAG, quadrotor.WIND, quadrotor.UPDRAFT)
STORED = 17  # of state and parameters; landmarks follow


def _seen(x: Array, mass: Array, drag: Array, wind: Array, updraft: Array, *marks: Array) -> Array:
    """(n, 16 + 2 K) position, heading, R' e3 in part, velocity, parameters and landmarks seen from the vehicle."""
    R = SO3.to_matrix(x[:, 3:7])
    ahead = np.hypot(R[:, 0, 0], R[:, 1, 0])
    c, s = R[:, 0, 0] / ahead, R[:, 1, 0] / ahead

    def turned(d: Array) -> Array:
        return np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1)

    heading, velocity = np.arctan2(s, c)[:, None], x[:, 7:]
    rows = [x[:, :3], heading, R[:, 2, :2], turned(velocity), velocity[:, 2:], mass, drag, turned(wind), updraft]
    return np.concatenate([*rows, *(turned(mark - x[:, :2]) for mark in marks)], axis=1)


def _apart(*arguments: Array) -> Array:
    """Difference of state, parameters and landmarks from those of the reference, both seen from their vehicles."""
    *now, reference = arguments
    ends = np.cumsum([part.shape[1] for part in now]).tolist()
    here = [reference[:, end - part.shape[1] : end] for part, end in zip(now, ends, strict=True)]
    apart = _seen(*now) - _seen(*here) - reference[:, ends[-1] :]
    turn = apart[:, 3:4]
    return np.concatenate([apart[:, :3], np.arctan2(np.sin(turn), np.cos(turn)), apart[:, 4:]], axis=1)


@cache
def arrival(landmarks: int) -> Residual:
    """``arrival(K)(x, mass, drag, wind, updraft, l_1, ..., l_K, reference)``: (n, 16 + 2 K).

    Rows are differences of position (3), heading, the first two entries of R' e3, velocity (3), mass, drag (3), wind
    (2), updraft and landmarks (2 each); velocity, wind and landmarks as seen from the vehicle's place and heading.
    reference: (33 + 4 K,), states, parameters and landmarks in the world side by side, and an offset of the rows. For
    vehicles that lean by less than a right angle.
    """
    size = STORED + 2 * landmarks
    kernel = StatedKernel(_apart, (*PARTS, *[fg.Rn(2)] * landmarks, (2 * size - 1,)), size - 1, name="arrival")
    return fg.residual(kernel)


def seen_from_the_vehicle(here: Array, step: Array, information: Array) -> tuple[Array, Array]:
    """Express a joint prior, frozen at ``here``, in the coordinates of :func:`arrival`.

    Args:
        here: (S,) where it was linearised: state, parameters and landmarks.
        step: (D,) from there to its lowest point, a right perturbation.
        information: (D, D) over right perturbations.

    Returns:
        Reference (S + D,), and information (D, D) of the rows of :func:`arrival`.
    """
    prior = arrival((len(here) - STORED) // 2)
    assert prior.jacobian is not None
    parts = np.split(here[None], [10, 11, 14, 16, *range(STORED, len(here), 2)], axis=1)
    J = np.concatenate(prior.jacobian(*parts, np.concatenate([here, np.zeros_like(step)])), axis=2)[0]
    inverse = np.linalg.inv(J)
    information = inverse.T @ information @ inverse
    return np.concatenate([here, J @ step]), 0.5 * (information + information.T)
