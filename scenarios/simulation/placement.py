"""Placement of discs that no map shows: drawn by seed, on a building's map or in a corridor.

In a building they matter: they stand on and beside the planned path. They are drawn at random and redrawn until a disc
of radius 0.25 m can still get from the start to every goal, so that an episode is hard but never impossible. Every
third obstacle moves, along or across the path. In a corridor all of them go to and fro where nothing else stands.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.planning.grid import is_free, path_exists
from unifg.scenarios.planning.polyline import polyline_distance
from unifg.scenarios.simulation.layouts import Layout
from unifg.scenarios.simulation.space import Obstacle
from unifg.typing import Array, ArrayLike

__all__ = ["PlacementRules", "place_obstacles", "random_mover"]

_DRAWS = 300  # per obstacle, before everything is begun anew
_RESTARTS = 4
_SWEEP_STEP = 0.02  # [m]; spacing at which a sweep is held against the map
_SHORTEST_SWEEP = 0.6  # [m]
_JOINT_MOVERS = 4  # movers whose ends are tried in every combination
_MOVER_FREE = 1.5  # of the whole path of a mover in a corridor around start and target [m]
_MOVER_GAP = 0.1  # between its hull and what stands [m]
_FRACTIONS = (0.25, 0.5, 0.75)  # places between the ends at which a way must remain as well


@dataclass(frozen=True)
class PlacementRules:
    """Rules for the positions of unforeseen obstacles.

    Attributes:
        radius: smallest and greatest radius [m].
        path_distance: greatest distance of a disc's first centre to the path [m].
        way_clearance: radius of the disc that must still get through [m].
        start_distance: least distance of a centre, all along a sweep, to the start [m].
        goal_distance: likewise to every goal [m].
        spacing: least distance between centres, all along the sweeps [m].
        speed: speed of the movers [m/s].
        sweep: shortest and longest segment drawn for a mover [m]; walls may shorten it to 0.6 m.
        every: one obstacle in this many moves, the last of each group.
    """

    radius: tuple[float, float] = (0.15, 0.25)
    path_distance: float = 0.3
    way_clearance: float = 0.25
    start_distance: float = 2.0
    goal_distance: float = 1.0
    spacing: float = 1.0
    speed: float = 0.3
    sweep: tuple[float, float] = (0.8, 2.0)
    every: int = 3


@dataclass(frozen=True)
class _Site:
    """Map, path and rules that every draw must fit."""

    occupancy: OccupancyMap
    distance_map: DistanceMap
    path: Array
    start: Array
    goals: Array
    rules: PlacementRules

    def room(self, points: Array) -> Array:
        """(n,) distance of points (n, 2) to the walls [m]; -1 where the map does not call them free."""
        return np.where(is_free(self.occupancy, points), self.distance_map.distance(points), -1.0)

    def passable(self, discs: Array) -> bool:
        """Return True if the start is still joined to every goal around discs (K, 3) x, y, radius [m]."""
        clearance = self.rules.way_clearance
        return all(path_exists(self.occupancy, self.distance_map, self.start, g, clearance, discs) for g in self.goals)


def place_obstacles(
    occupancy: OccupancyMap,
    distance_map: DistanceMap,
    path: Array,
    count: int,
    rng: np.random.Generator,
    *,
    start: ArrayLike | None = None,
    goals: ArrayLike | None = None,
    rules: PlacementRules | None = None,
) -> list[Obstacle]:
    """Draw discs on and beside the planned path that leave a way through.

    Obstacles with ``index % 3 == 2`` move to and fro on a straight segment, across the path or along it,
    whose sweep keeps off the walls. A way remains with the movers at any combination of their ends, and with
    all of them part of the way between.

    Args:
        occupancy: the map; obstacles stand in its free cells.
        distance_map: its signed distance.
        path: (P, 3) planned path, all goals together [m, m, rad].
        count: number of obstacles.
        rng: source of the draws.
        start: (2,) or (3,) start [m]; None for the path's first point.
        goals: (G, 2) or (G, 3) goals [m]; None for the path's last point.
        rules: distances and sizes; None for the usual ones.

    Returns:
        ``count`` obstacles, or as many as found a place that leaves a way; none where there is no way without them.
    """
    rules = rules or PlacementRules()
    first = path[0, :2] if start is None else np.asarray(start, dtype=np.float64)[:2]
    ends = path[-1:, :2] if goals is None else np.atleast_2d(np.asarray(goals, dtype=np.float64))[:, :2]
    if count <= 0:
        return []
    site = _Site(occupancy, distance_map, path, first, ends, rules)
    best: list[Obstacle] = []
    for _ in range(_RESTARTS if site.passable(np.zeros((0, 3))) else 0):
        placed: list[Obstacle] = []
        for index in range(count):
            obstacle = _draw_until_good(site, placed, index % rules.every == rules.every - 1, rng)
            if obstacle is None:
                break
            placed.append(obstacle)
        best = max(best, placed, key=len)
        if len(placed) == count:
            break
    return best


def _draw_until_good(site: _Site, placed: list[Obstacle], moves: bool, rng: np.random.Generator) -> Obstacle | None:
    for _ in range(_DRAWS):
        obstacle = _draw(site, moves, rng)
        if obstacle is not None and _keeps_distance(site, placed, obstacle) and _leaves_way(site, [*placed, obstacle]):
            return obstacle
    return None


def _draw(site: _Site, moves: bool, rng: np.random.Generator) -> Obstacle | None:
    """One candidate, or None if it would stand in a wall or has no room to move."""
    rules = site.rules
    # The same number of draws for every candidate, whatever becomes of it.
    radius, offset, where = rng.uniform([rules.radius[0], -1.0, 0.0], [rules.radius[1], 1.0, 1.0])
    across, slant, length, sense = rng.uniform([0.0, -0.35, rules.sweep[0], -1.0], [1.0, 0.35, rules.sweep[1], 1.0])
    point = site.path[min(int(where * len(site.path)), len(site.path) - 1)]
    normal = np.array([-np.sin(point[2]), np.cos(point[2])])
    centre = point[:2] + offset * rules.path_distance * normal
    near = polyline_distance(centre[None], site.path)[0] <= rules.path_distance
    if not near or site.room(centre[None])[0] < radius:
        return None
    if not moves:
        return Obstacle(centre, float(radius))
    if across < 0.5:  # towards the path and over it
        heading = point[2] + slant - np.copysign(np.pi / 2.0, offset)
    else:
        heading = point[2] + slant + (0.0 if sense > 0.0 else np.pi)
    direction = np.array([np.cos(heading), np.sin(heading)])
    steps = np.arange(0.0, length + _SWEEP_STEP, _SWEEP_STEP)
    blocked = site.room(centre + steps[:, None] * direction) < radius + _SWEEP_STEP
    reach = steps[max(int(np.argmax(blocked)) - 1, 0)] if blocked.any() else float(length)
    if reach < _SHORTEST_SWEEP:
        return None
    return Obstacle(centre, float(radius), centre + min(float(reach), float(length)) * direction, rules.speed)


def _keeps_distance(site: _Site, placed: list[Obstacle], obstacle: Obstacle) -> bool:
    """Return True if the obstacle, all along its sweep, is far enough from start, goals and the other obstacles."""
    sweep = obstacle.positions(np.linspace(0.0, 1.0, 41))
    rules = site.rules
    if np.linalg.norm(sweep - site.start, axis=1).min() < rules.start_distance:
        return False
    if np.linalg.norm(sweep[:, None] - site.goals[None], axis=2).min() < rules.goal_distance:
        return False
    ends = np.array([0.0, 1.0])
    return all(polyline_distance(sweep, other.positions(ends)).min() >= rules.spacing for other in placed)


def _leaves_way(site: _Site, obstacles: list[Obstacle]) -> bool:
    """Return True if the start is joined to every goal wherever the movers may be."""
    fixed = [(*o.centre, o.radius) for o in obstacles if not o.moving]
    movers = [o for o in obstacles if o.moving]

    def at(obstacle: Obstacle, fractions: Array) -> list[tuple[float, float, float]]:
        return [(*place, obstacle.radius) for place in obstacle.positions(fractions)]

    # Discs everywhere along the sweeps at once: when that leaves a way, every single moment does.
    everywhere = np.linspace(0.0, 1.0, 9)
    sweeps = [disc for mover in movers for disc in at(mover, everywhere)]
    if site.passable(np.array([*fixed, *sweeps]).reshape(-1, 3)):
        return True
    if not movers:
        return False
    # Far movers, when there are many, count with their whole sweep: stricter than needed, never weaker.
    latest = movers[-1].centre
    movers.sort(key=lambda mover: float(np.linalg.norm(mover.centre - latest)))
    joint, far = movers[:_JOINT_MOVERS], movers[_JOINT_MOVERS:]
    fixed += [disc for mover in far for disc in at(mover, everywhere)]
    moments = [*itertools.product((0.0, 1.0), repeat=len(joint)), *((f,) * len(joint) for f in _FRACTIONS)]
    return all(
        site.passable(np.array([*fixed, *(at(m, np.array([f]))[0] for m, f in zip(joint, moment, strict=True))]))
        for moment in moments
    )


def random_mover(layout: Layout, index: int, rng: np.random.Generator) -> Obstacle:
    """Draw a disc that moves on a straight segment between start and target.

    The radius is uniform in 0.3 to 0.5 m, the speed in 0.3 to 0.8 m/s, the length of the segment in 1.5 to 4 m; its
    middle is uniform over the layout's ground between start and target, its direction uniform. A segment is drawn
    again if on it the disc would come within 0.1 m of a cylinder or a wall, leave the ground, or come nearer than
    1.5 m to start or target. Movers may cross each other.

    Args:
        layout: what stands.
        index: of the mover, for the message.
        rng: source of all numbers.

    Raises:
        ScenarioError: if a thousand draws find no room for it.
    """
    ends = np.stack([layout.start[:2], layout.target[:2]])
    low, high = layout.size
    left, right = np.sort(ends[:, 0])
    for _ in range(1000):
        radius, speed, length = rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.8), rng.uniform(1.5, 4.0)
        centre = np.array([rng.uniform(left, right), rng.uniform(low[1], high[1])])
        angle = rng.uniform(0.0, 2.0 * np.pi)
        half = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        path: Array = centre + np.linspace(-1.0, 1.0, 41)[:, None] * half
        if (path < low + radius).any() or (path > high - radius).any():
            continue
        # Between samples, at most 0.1 m apart, the distance is at most 0.05 m smaller.
        if layout.distance(path).min() < radius + _MOVER_GAP + 0.05:
            continue
        if np.linalg.norm(path[:, None, :] - ends[None], axis=2).min() < radius + _MOVER_FREE + 0.05:
            continue
        return Obstacle(centre=path[0], radius=float(radius), end=path[-1], speed=float(speed))
    raise ScenarioError(
        f"layout {layout.name!r} has no room for mover {index}: 1000 draws met a cylinder, a wall, start or target; "
        "ask for fewer movers or place them yourself"
    )
