"""Obstacles of the horizon, in slots that keep their obstacle from tick to tick, and their clearances.

A graph has a fixed number of slots. An obstacle keeps its slot as long as it is chosen, so that multipliers of the
tick before still belong to it. Unused slots wait far away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios.perception.belief import Landmarks
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.polyline import segment_distance
from unifg.scenarios.quadrotor.braking import DELAY, stopping_path
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings
from unifg.typing import Array, BoolArray, IntArray

FAR_AWAY = 1e3  # [m]; where an unused slot waits
SPARE = 0.01  # [m] that a limit stays below what a braking vehicle keeps at first
DODGE = 5.0  # [m/s^2] with which a vehicle can get out of the way


@dataclass(frozen=True)
class SlotObstacles:
    """Contents of the slots at one tick; C slots of cylinders, then those of movers, M in all.

    Attributes:
        names: (M,) landmark ids, -1 for what is none.
        centres: (N, M, 2) at nodes 1..N [m].
        radii: (M,) [m].
        limits: (N, M) least distance of the vehicle's centre from their surfaces [m].
        changed: (M,) whether the slot held something else at the last tick.
        wall_limits: (N, W) least distance from the walls [m].
    """

    names: IntArray
    centres: Array
    radii: Array
    limits: Array
    changed: BoolArray
    wall_limits: Array

    def room(self, states: Array, walls: Array) -> float:
        """Least distance of the nodes after the first beyond what they have to keep clear [m], negative in a violation.

        Args:
            states: (k, 10), the first being the present, k at most N + 1.
            walls: (W, 2, 2) segments [m].
        """
        ahead = states[1:, :2]
        count = len(ahead)
        gaps = np.hypot(*np.moveaxis(ahead[:, None] - self.centres[:count], 2, 0)) - self.radii
        beside = segment_distance(ahead, walls) - self.wall_limits[:count]
        return float(min((gaps - self.limits[:count]).min(initial=np.inf), beside.min(initial=np.inf)))


class Slots:
    """Chooses the obstacles of every tick."""

    def __init__(self, settings: ControllerSettings, walls: Array) -> None:
        """Begin with empty slots."""
        self._settings = settings
        self._walls = walls
        self._names = np.full(settings.cylinders, -1, dtype=np.intp)

    def fill(self, state: Array, positions: Array, landmarks: Landmarks, movers: Tracks) -> SlotObstacles:
        """Fill the slots for a vehicle in a state (10,) that is to go along positions (N + 1, 3) [m]."""
        s = self._settings
        n, m = s.horizon, s.cylinders + s.movers
        known = landmarks.cylinders
        before = self._names
        rows = self._assign(known, positions)
        used = np.flatnonzero(rows >= 0)
        centres, radii, wider = np.full((n, m, 2), FAR_AWAY), np.zeros(m), np.zeros((n, m))
        chosen = rows[used]
        centres[:, used], radii[used] = known.positions[chosen], known.radii[chosen]
        spread = np.sqrt(np.linalg.eigvalsh(known.covariances[chosen])[:, -1]) if len(chosen) else np.zeros(0)
        wider[:, used] = np.minimum(s.sigmas * spread, s.margin_limit)
        times = s.dt * np.arange(1.0, n + 1)
        near = np.argsort(np.hypot(*(movers.centre - state[:2]).T) - movers.radius, kind="stable")[: s.movers]
        places = s.cylinders + np.arange(len(near))
        centres[:, places] = movers.centre[near] + times[:, None, None] * movers.expected_velocity(state[:2])[near]
        radii[places] = movers.radius[near]
        wider[:, places] = s.mover_margin + s.mover_growth * times[:, None]
        # What is near already, or cannot be avoided in the next moment, is not forbidden until there was time to dodge.
        stopping = stopping_path(state[:3], state[7:10], times)
        slack = (0.5 * DODGE * np.maximum(times - DELAY, 0.0) ** 2 - SPARE)[:, None]
        kept = np.hypot(*np.moveaxis(stopping[:, None] - centres, 2, 0)) - radii + slack
        beside = segment_distance(stopping, self._walls) + slack
        least = s.vehicle_radius + s.margin
        names = np.concatenate([self._names, np.full(s.movers, -1, dtype=np.intp)])
        changed = np.concatenate([self._names != before, np.ones(s.movers, dtype=bool)])
        return SlotObstacles(names, centres, radii, np.minimum(least + wider, kept), changed, np.minimum(least, beside))

    def _assign(self, known: Landmarks, positions: Array) -> IntArray:
        """Row of ``known`` in every slot of cylinders, -1 for none: those nearest to where the vehicle is to be."""
        gaps = np.hypot(*np.moveaxis(known.positions - positions[:, None, :2], 2, 0)) - known.radii
        chosen = np.argsort(gaps.min(axis=0), kind="stable")[: self._settings.cylinders]
        row_of = {int(known.ids[row]): int(row) for row in chosen}
        names = reassigned(self._names.tolist(), list(row_of))
        self._names = np.array(names, dtype=np.intp)
        return np.array([row_of.get(name, -1) for name in names], dtype=np.intp)


def reassigned(held: list[int], wanted: list[int]) -> list[int]:
    """Contents of the slots: what is wanted and was ``held`` keeps its slot, the rest fills the others in order.

    Args:
        held: what each slot has held; -1 for nothing.
        wanted: what the slots are to hold, at most as much as there are slots.
    """
    fresh = [name for name in wanted if name not in held]
    return [name if name in wanted else fresh.pop(0) if fresh else -1 for name in held]
