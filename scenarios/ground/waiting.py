"""Waiting for movers: a search over places along a path and times.

Dynamic programming over places a step apart and times a step apart: in a step the robot goes on by one place or waits.
What is occupied costs, so that a robot that is where a mover comes leaves it soon; of the ways that cost the same the
earliest counts. A mover that is known to go to and fro occupies where it will be then, and for a rest without an end
all of where it goes. Others occupy where they were lately and where they can be until the robot is at rest.
"""

from __future__ import annotations

import numpy as np

from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array, BoolArray, IntArray

LOOK = 60  # steps ahead
TOUCH = 100.0  # cost of a step where it is occupied, in places of progress at the end
EAGER = 0.01  # of being one place farther back for a step
EARLY = 2  # steps that a mover may be early or late by


def waiting(s: ControllerSettings, pose: Array, places: Array, movers: Tracks) -> IntArray:
    """Indices (LOOK + 1,) of the places along a path to be at in every step of the controller.

    The places (LOOK + 1, 2) are a step at full speed apart. Where no wait is safe from all movers those that are not
    known to go to and fro are left to the controller: beside them there may be room.
    """
    for those in (movers, movers.at(movers.sweeps)):
        occupied, unsafe = occupancy(s, pose, places, those)
        steps = timed(occupied, unsafe)
        if not unsafe[steps[-1]] and not occupied[np.arange(len(steps)), steps].any():
            break
    return steps


def timed(occupied: BoolArray, unsafe: BoolArray) -> IntArray:
    """Places (K + 1,) at every step, from the first place on.

    Args:
        occupied: (K + 1, S) of each place at each time.
        unsafe: (S,) of each place, for a rest that has no end.
    """
    steps, place = len(occupied) - 1, np.arange(occupied.shape[1], dtype=np.float64)
    value, goes = TOUCH * unsafe - place, np.zeros((steps, len(place)), dtype=bool)
    for k in range(steps - 1, -1, -1):
        value = value + TOUCH * occupied[k + 1] - EAGER * place
        onward = np.append(value[1:], np.inf)
        goes[k], value = onward < value, np.minimum(onward, value)
    places = np.zeros(steps + 1, dtype=np.intp)
    for k in range(steps):
        places[k + 1] = places[k] + goes[k, places[k]]
    return places


def occupancy(s: ControllerSettings, pose: Array, places: Array, movers: Tracks) -> tuple[BoolArray, BoolArray]:
    """Arguments of :func:`timed` for places (S, 2) along a path, among movers."""
    times: Array = s.dt * np.arange(LOOK + 1.0)
    known = movers.sweeps
    walk, reach = np.hypot(*movers.velocity.T), s.robot_radius + s.disc_clearance + movers.radius
    gap = _distances(movers.beside(places), places[:, None]) - reach  # (S, m)
    unsafe = gap < np.where(known, 0.0, walk * s.mover_surprise)
    ways = movers.centre + times[:, None, None] * movers.expected_velocity(pose[:2])
    ways[:, known] = movers.at(known).swept(times)
    met = _distances(ways[:, None], places[:, None]) < reach  # (K + 1, S, m)
    met[s.horizon :] &= known
    sure = met.copy()
    for shift in range(1, EARLY + 1):
        sure[shift:] |= met[:-shift]
        sure[:-shift] |= met[shift:]
    near = gap < walk * np.minimum(times, s.mover_surprise)[:, None, None]
    return np.any(np.where(known, sure, met | near), axis=-1), np.any(unsafe, axis=-1)


def _distances(first: Array, second: Array) -> Array:
    offset = first - second
    return np.hypot(offset[..., 0], offset[..., 1])
