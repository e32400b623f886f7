"""Futures of movers that a plan prepares for: a tail of the horizon for each of the likeliest, the last for the rest.

A mover goes to and fro, goes on or stands; the weights are those of its track. In the tail of a hypothesis it is kept
off where it will be, as one whose motion is known. In the last tail, and before the tails part, a mover may do
anything that it can (`drive_parts.disc_limits`), so that the plan that is kept does not depend on a guess.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from unifg.horizon import Tree
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.perception.motion_model import UNLIKELY
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array

FAR = 100.0  # [m] to where a mover that goes on turns round
STANDING = 1e-6  # [m/s]
REST = 0.1  # probability of the last tail at least


@dataclass(frozen=True)
class Futures:
    """Joint hypotheses of movers, one for each tail, and their probabilities.

    Attributes:
        tracks: of each tail but the last, in which movers do as they are known to.
        probabilities: (L,) of the tails.
    """

    tracks: tuple[Tracks, ...]
    probabilities: Array


def horizon_of(s: ControllerSettings) -> Tree | int:
    """Steps of the horizon, a tree where movers have several futures."""
    if not s.branches:
        return s.horizon
    return Tree.branched(s.shared, (s.horizon - s.shared,) * s.tails)


def futures(s: ControllerSettings, tracks: Tracks) -> Futures:
    """The likeliest joint hypotheses of tracks, without unlikely ones; fewer than tails where there are no more."""
    free = np.flatnonzero(tracks.mover & ~tracks.sweeps).tolist()
    count = s.tails - 1 if s.branches else 1
    joint = list(product(*([k for k in range(3) if tracks.weights[mover, k] > UNLIKELY] for mover in free)))
    likely = np.array([np.prod(tracks.weights[free, list(kinds)]) for kinds in joint])
    found = np.argsort(-likely, kind="stable")[: count if free else 0]
    weights = np.zeros(count + 1)
    weights[: len(found)] = likely[found]
    weights[-1] = max(1.0 - weights.sum(), REST)
    hypotheses = tuple(_hypothesis(tracks, free, joint[k]) for k in found.tolist())
    return Futures(hypotheses, weights / weights.sum())


def _hypothesis(tracks: Tracks, movers: list[int], kinds: tuple[int, ...]) -> Tracks:
    """Tracks in which each of the movers is known to do one thing."""
    sweep = tracks.sweep.copy()
    for mover, kind in zip(movers, kinds, strict=True):
        if kind == 0:
            sweep[mover] = tracks.wave[mover]
            continue
        speed = float(np.hypot(*tracks.velocity[mover])) if kind == 1 else 0.0
        way = tracks.velocity[mover] / speed if speed > STANDING else np.array([1.0, 0.0])
        here = tracks.centre[mover]
        sweep[mover] = [*here, *(here + FAR * way), 0.0, max(speed, STANDING)]
    return replace(tracks, sweep=sweep)
