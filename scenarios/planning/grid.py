"""Global paths: A* on the inflated grid, shortened and smoothed until an MPC can follow the headings.

Only cells known to be free whose signed distance reaches the inflation are entered, and a diagonal step needs
both cells beside it: the interpolated clearance then never falls below the inflation anywhere between the
cells. The cost of a step is its length times one plus a penalty for small clearance, so paths run down the
middle of corridors (Bazzana et al. 2022, section VII, plan the same way; the smoothing is ours).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator
from functools import wraps
from typing import ParamSpec, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from unifg.codegen.jit import compiled
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap, bilinear
from unifg.scenarios.planning.heap import pop, push
from unifg.scenarios.planning.polyline import headed, resample
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

Scalar = TypeVar("Scalar", bound=np.generic)
P = ParamSpec("P")
T = TypeVar("T")

_log = logging.getLogger("unifg")

WEIGHTS = (0.125, 0.75, 0.125)  # of the quadratic B-spline in the middle of a cell
SPACING = 0.05  # between the poses of a planned path [m]
_COMFORT = 0.15  # inflation beyond the robot's radius that is tried first [m]
_LEVEL_STEP = 0.01  # the inflation is lowered by steps of this size until a way exists [m]
_FREE = 2.0  # clearance beyond the robot's radius that no inflation asks for [m]
_WIDE = 0.6  # clearance beyond the robot's radius from which more is worth nothing [m]
_PENALTY = 4.0  # a path touching the inflation costs 1 + this per metre
_LOOKAHEAD = 100  # longest shortcut tried, in strides along the path
_SMOOTHING_SWEEPS = 400  # diffusion length sqrt(0.5 sweeps) SPACING = 0.7 m
_AT_ONCE = 10_000  # expansions
_SWEEPS = 50  # of these made at once
_CELLS, _SMOOTHED = 16, 2  # cells looked at, and points smoothed, for as much work as an expansion
_POINTS = 10  # expansions for as much work as a point and stride of a path that is shortened
_highest: WeakKeyDictionary[DistanceMap, Array] = WeakKeyDictionary()
_ATTACH = 0.5  # how far start or goal may lie from the inflated free space [m]


class Clearance:
    """Distance to the nearest wall or disc, on the cells and between them."""

    def __init__(
        self, occupancy: OccupancyMap, distance_map: DistanceMap, discs: ArrayLike | None, robot_radius: float
    ) -> None:
        """Lower a map's distances around discs (K, 3) x, y, radius [m], as far as a robot's radius [m] makes a need."""
        self.occupancy = occupancy
        self.field = distance_map
        # Compiled for one layout: a part of a map, or a read-only array, would be compiled for anew.
        self.discs: Array = plain(np.asarray([] if discs is None else discs, dtype=np.float64).reshape(-1, 3))
        self.known: BoolArray = plain(occupancy.free)
        self.grid: Array = distance_map.values
        if len(self.discs):
            self.grid = self.grid.copy()
        for x, y, radius in self.discs:
            self._lower_around(x, y, radius, robot_radius + _FREE)
        self.passable: BoolArray = occupancy.free

    def restrict(self, least: float) -> None:
        """Enter no cell where the smoothed field of :class:`SmoothField`, which a controller keeps to, is lower.

        It is looked at in the middle of the cell and of its sides: the middle line of a door may run between two cells.
        """
        highest = _highest.get(self.field)
        if highest is None:
            highest = _highest[self.field] = self._highest()
        self.passable = self.occupancy.free & (highest >= least)

    def _highest(self) -> Array:
        """Greatest smoothed distance (H, W) in the middle of each cell and of its sides [m]."""
        values = self.field.values
        highest = smoothed(values)
        for axis in (0, 1):
            side = ndimage.correlate1d(
                ndimage.correlate1d(values, [0.5, 0.5], axis=axis, mode="nearest"),
                WEIGHTS,
                axis=1 - axis,
                mode="nearest",
            )  # between the cell before and this one
            after = np.roll(side, -1, axis=axis)
            highest = np.maximum(highest, np.maximum(side, after))
        return highest

    def _lower_around(self, x: float, y: float, radius: float, beyond: float) -> None:
        reach = (radius + beyond) / self.occupancy.resolution
        column, row = self.occupancy.world_to_grid(np.array([x, y])) - 0.5
        height, width = self.grid.shape
        rows = np.arange(max(0, int(row - reach)), min(height, math.ceil(row + reach) + 1))
        columns = np.arange(max(0, int(column - reach)), min(width, math.ceil(column + reach) + 1))
        if rows.size and columns.size:
            part = np.ix_(rows, columns)
            away = np.hypot(rows[:, None] - row, columns[None, :] - column) * self.occupancy.resolution - radius
            self.grid[part] = np.minimum(self.grid[part], away)

    def at(self, points: Array) -> Array:
        """(..., 2) [m] -> (...,) [m]."""
        distance = self.field.distance(points)
        for x, y, radius in self.discs:
            distance = np.minimum(distance, np.hypot(points[..., 0] - x, points[..., 1] - y) - radius)
        return distance

    def open_cells(self, level: float) -> BoolArray:
        """Cells (H, W) that may be entered at this inflation."""
        return self.passable & (self.grid >= level)

    def centres(self, cells: IntArray) -> Array:
        """World positions (n, 2) [m] of the centres of cells (n, 2) given as row, column."""
        return self.occupancy.grid_to_world(cells[:, ::-1].astype(np.float64) + 0.5)

    def attach(self, point: Array, cells: BoolArray, least: float) -> tuple[int, int] | None:
        """The nearest of `cells` reached from `point` on a straight line with at least this clearance."""
        column, row = self.occupancy.world_to_grid(point)
        reach = _ATTACH / self.occupancy.resolution
        bottom, left = max(0, math.floor(row - reach)), max(0, math.floor(column - reach))
        window = cells[bottom : max(0, math.ceil(row + reach)), left : max(0, math.ceil(column + reach))]
        candidates = np.argwhere(window) + np.array([bottom, left])
        if not len(candidates):
            return None
        centres = self.centres(candidates)
        nearest = np.argsort(np.hypot(*(centres - point).T), kind="stable")[:64]
        line = np.linspace(0.0, 1.0, 21)[None, :, None]
        samples = point + line * (centres[nearest, None, :] - point)
        clear = np.all((self.at(samples) >= least - 1e-9) & is_free(self.occupancy, samples), axis=1)
        if not clear.any():
            return None
        row_found, column_found = candidates[nearest[int(np.argmax(clear))]]
        return int(row_found), int(column_found)


def is_free(occupancy: OccupancyMap, points: Array) -> BoolArray:
    """Flags of points (..., 2) [m] that lie in cells of the map known to be free."""
    cells = np.floor(occupancy.world_to_grid(points)).astype(np.intp)
    height, width = occupancy.shape
    row, column = cells[..., 1], cells[..., 0]
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.asarray(inside & occupancy.free[row.clip(0, height - 1), column.clip(0, width - 1)], dtype=bool)


def plain(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """The array, or a copy of it, row by row and to be written to."""
    return np.require(array, requirements=["C", "W"])


Planning: TypeAlias = Generator[int, None, Array]
"""A search in parts, each of which yields its work in expansions of A*; it returns a path."""


def finished(work: Generator[int, None, T]) -> T:
    """Result of work in parts, after all of them."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: T = end.value
            return result


def at_once(work: Callable[P, Generator[int, None, T]]) -> Callable[P, T]:
    """Function that does work in parts without a pause, with its arguments, result and errors."""

    @wraps(work)
    def whole(*args: P.args, **options: P.kwargs) -> T:
        return finished(work(*args, **options))

    return whole


def planning(
    occupancy: OccupancyMap,
    distance_map: DistanceMap,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    robot_radius: float,
    clearance_least: float | None = None,
    extra_discs: ArrayLike | None = None,
) -> Planning:
    """Find a short path that prefers the middle of free space and still passes the gaps that must be passed.

    Args:
        occupancy: the map; only its free cells are entered.
        distance_map: its signed distance.
        start: (3,) or (2,) [m, m, rad]; the heading is not used.
        goal: (3,) [m, m, rad].
        robot_radius: radius of the robot's disc [m].
        clearance_least: lowest distance from the robot's centre to walls that is tried [m], by default the radius.
            The radius plus 0.15 m is tried first; where no such way exists it is lowered step by step.
        extra_discs: (K, 3) x, y, radius [m] of obstacles that are not on the map.

    Yields:
        Work of each part, in expansions.

    Returns:
        (P, 3) poses [m, m, rad] from start to goal, evenly spaced by about 0.05 m of arc length. Headings run
        along the path; the last one is the goal's.

    Raises:
        ScenarioError: start or goal is off the map, not in free space, too near to a wall or a disc, or there
        is no way.
    """
    start_pose, goal_pose = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
    clearance = Clearance(occupancy, distance_map, extra_discs, robot_radius)
    for name, pose in (("start", start_pose), ("goal", goal_pose)):
        _check_standing(clearance, name, pose, robot_radius)
    least = robot_radius if clearance_least is None else max(clearance_least, robot_radius)
    preferred = max(robot_radius + _COMFORT, least)

    if least > robot_radius:
        clearance.restrict(least)
    steps = math.ceil((preferred - least) / _LEVEL_STEP - 1e-9)
    for level in np.linspace(preferred, least, max(2, steps + 1)):
        route = _connected(clearance, start_pose[:2], goal_pose[:2], float(level), robot_radius)
        yield clearance.grid.size // _CELLS
        if route is not None:
            break
    else:
        raise ScenarioError(
            f"planner: no way from ({start_pose[0]:.2f}, {start_pose[1]:.2f}) to "
            f"({goal_pose[0]:.2f}, {goal_pose[1]:.2f}) through the free space of map "
            f"{occupancy.name!r} for a robot of radius {robot_radius} m that keeps {least - robot_radius:.2f} m from "
            "walls; choose another goal, or a map without the wall, gap or unknown area between them"
        )
    if level < preferred - 1e-9:
        _log.info("planner: inflation lowered from %.2f m to %.2f m to find a way", preferred, level)

    chain = yield from _cheapest(clearance, *route, robot_radius)
    points = np.vstack([start_pose[:2], clearance.centres(chain), goal_pose[:2]])
    # Short lines first, then long ones between points further apart: together they undo the eight directions
    # of the grid.
    for stride in (1, 5):
        fine = resample(points, SPACING)
        points = _shorten(clearance, fine, float(level), robot_radius, stride)
        yield _POINTS * stride * len(fine)
    points = plain(resample(points, SPACING))
    for _ in range(_SMOOTHING_SWEEPS // _SWEEPS):
        _diffuse(clearance.field.table, clearance.known, clearance.discs, points, preferred, _SWEEPS)
        yield _SWEEPS * len(points) // _SMOOTHED
    points = plain(resample(points, SPACING))
    _leave_corners(clearance.field.table, clearance.discs, points, float(level))
    return headed(points, float(goal_pose[2]))


plan = at_once(planning)
"""The same at once: it returns the path."""


def smoothed(values: Array) -> Array:
    """Values (H, W) of the quadratic B-splines over a grid at the middles of its cells, its border repeated."""
    across = ndimage.correlate1d(values, WEIGHTS, axis=0, mode="nearest")
    found: Array = ndimage.correlate1d(across, WEIGHTS, axis=1, mode="nearest")
    return found


def path_exists(
    occupancy: OccupancyMap,
    distance_map: DistanceMap,
    start: ArrayLike,
    goal: ArrayLike,
    clearance: float,
    discs: ArrayLike | None = None,
) -> bool:
    """Return True if free space with this clearance to walls and discs joins start and goal.

    Args:
        occupancy: the map.
        distance_map: its signed distance.
        start: (2,) or (3,) [m]; may itself be nearer to a wall than `clearance`, by up to half a metre's
            walk.
        goal: likewise.
        clearance: distance from the robot's centre to every wall and disc along the way [m].
        discs: (K, 3) x, y, radius [m] of obstacles that are not on the map.
    """
    room = Clearance(occupancy, distance_map, discs, clearance)
    first, last = (np.asarray(pose, dtype=np.float64)[:2] for pose in (start, goal))
    return _connected(room, first, last, clearance, 0.0) is not None


def _check_standing(clearance: Clearance, name: str, pose: Array, robot_radius: float) -> None:
    """Refuse a pose at which the robot cannot stand, saying why."""
    occupancy = clearance.occupancy
    where = f"planner: {name} ({pose[0]:.2f}, {pose[1]:.2f})"
    if not np.all(np.isfinite(pose)):
        raise ScenarioError(f"{where} is not finite; give x, y in metres and a heading in radians")
    column, row = occupancy.world_to_grid(pose[:2])
    height, width = occupancy.shape
    if not (0 <= column < width and 0 <= row < height):
        low, high = occupancy.bounds.min(axis=0), occupancy.bounds.max(axis=0)
        raise ScenarioError(
            f"{where} lies outside map {occupancy.name!r}, which covers x {low[0]:.2f} to {high[0]:.2f}, "
            f"y {low[1]:.2f} to {high[1]:.2f} m; choose a point within"
        )
    if not is_free(occupancy, pose[:2]):
        kind = "an occupied" if occupancy.occupied[int(row), int(column)] else "an unknown"
        raise ScenarioError(f"{where} lies in {kind} cell of map {occupancy.name!r}; choose a free one")
    distance = float(clearance.at(pose[:2]))
    if distance < robot_radius:
        raise ScenarioError(
            f"{where} is {distance:.3f} m from the nearest wall or obstacle, less than the robot's radius "
            f"{robot_radius} m; move it away from the wall"
        )


_Route = tuple[BoolArray, tuple[int, int], tuple[int, int]]


def _connected(clearance: Clearance, start: Array, goal: Array, level: float, least: float) -> _Route | None:
    """The open cells that join start and goal and the two cells at which these join them, or None."""
    cells = clearance.open_cells(level)
    labels, _ = ndimage.label(cells)  # joined along edges: every joined square of cells can also be crossed diagonally
    first = clearance.attach(start, cells, least)
    if first is None:
        return None
    component = labels == labels[first]
    last = clearance.attach(goal, component, least)
    if last is None:
        return None
    return component, first, last


def cost_per_metre(distance: Array, robot_radius: float) -> Array:
    """Cost per metre at these clearances: one, and more where walls are near."""
    lacking = np.clip((robot_radius + _WIDE - distance) / _WIDE, 0.0, 1.0)
    return 1.0 + _PENALTY * lacking * lacking


def _cheapest(
    clearance: Clearance,
    cells: BoolArray,
    first: tuple[int, int],
    last: tuple[int, int],
    robot_radius: float,
) -> Generator[int, None, IntArray]:
    """Cheapest chain of neighbouring open cells, (n, 2) as row, column; yields expansions."""
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    corner = np.array([rows[0], columns[0]])
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    cells = cells[part]
    cost = plain(cost_per_metre(clearance.grid[part], robot_radius))
    source, target = (np.array(cell) - corner for cell in (first, last))
    yield cells.size // _CELLS
    before, _ = yield from searching(plain(cells), cost, source, target)
    chain = [int(source[0] * cells.shape[1] + source[1])]
    end = int(target[0] * cells.shape[1] + target[1])
    while chain[-1] != end:
        chain.append(int(before[chain[-1]]))
    found: IntArray = np.column_stack(np.divmod(chain, cells.shape[1])) + corner
    return found


def searching(
    cells: BoolArray, cost: Array, source: IntArray, target: IntArray
) -> Generator[int, None, tuple[IntArray, Array]]:
    """Predecessor and cost of every cell on the cheapest chain from ``target``, flat, as far as ``source`` needs.

    Hart, Nilsson and Raphael's A* with the cheapest that eight directions allow; cells cost one per side at least. The
    search runs from the target, so that the chain of predecessors runs from start to goal. With a source that is no
    cell it goes on to all that can be reached. Yields expansions, `_AT_ONCE` at the most.
    """
    count = cells.size
    before, spent, done = np.full(count, -1, dtype=np.int64), np.full(count, np.inf), np.zeros(count, dtype=np.bool_)
    keys, places = np.empty(4 * count + 16), np.empty(4 * count + 16, dtype=np.int64)
    begin = int(target[0] * cells.shape[1] + target[1])
    spent[begin] = 0.0
    keys[0], places[0], size = 0.0, begin, 1
    while size > 0:
        size = expand(cells, cost, source, before, spent, done, keys, places, size, _AT_ONCE)
        yield _AT_ONCE
    return before, spent


@compiled
def expand(
    cells: BoolArray, cost: Array, source: IntArray, before: IntArray, spent: Array, done: BoolArray, keys: Array,
    places: IntArray, size: int, most: int,
) -> int:  # fmt: skip
    """Go on with a search by so many expansions; size of the heap afterwards, 0 at the end."""
    height, width = cells.shape
    goal = source[0] * width + source[1]
    while size > 0 and most > 0:
        current = pop(keys, places, size)
        size -= 1
        if done[current]:
            continue
        done[current] = True
        most -= 1
        if current == goal:
            return 0
        row, column = current // width, current % width
        for k in range(9):
            i, j = row + k // 3 - 1, column + k % 3 - 1
            if i < 0 or i >= height or j < 0 or j >= width or not cells[i, j]:
                continue
            neighbour = i * width + j
            if done[neighbour] or not (cells[row, j] and cells[i, column]):
                continue
            length = math.sqrt(2.0) if i != row and j != column else 1.0
            total = spent[current] + 0.5 * length * (cost[row, column] + cost[i, j])
            if total >= spent[neighbour] or size + 1 >= len(keys):
                continue
            spent[neighbour], before[neighbour] = total, current
            away, aside = abs(i - source[0]), abs(j - source[1])
            key = total + max(away, aside) + (math.sqrt(2.0) - 1.0) * min(away, aside)
            size = push(keys, places, size, key, neighbour)
    return size


@compiled
def _nearest(table: Array, discs: Array, x: float, y: float) -> tuple[float, float, float]:
    """Clearance at a point, and its gradient there."""
    distance, slope_x, slope_y = bilinear(table, x, y)
    for k in range(len(discs)):
        across, along = x - discs[k, 0], y - discs[k, 1]
        norm = math.hypot(across, along)
        if norm - discs[k, 2] < distance:
            distance = norm - discs[k, 2]
            slope_x, slope_y = across / max(norm, 1e-9), along / max(norm, 1e-9)
    return distance, slope_x, slope_y


def _shorten(clearance: Clearance, points: Array, level: float, robot_radius: float, stride: int) -> Array:
    """Replace stretches of the grid path by straight lines that cost no more and keep the inflation."""
    middle = clearance.at(0.5 * (points[1:] + points[:-1]))
    step = np.hypot(*np.diff(points, axis=0).T)
    spent = np.concatenate([[0.0], np.cumsum(step * cost_per_metre(middle, robot_radius))])
    # The stubs from start and goal to the grid may be nearer to walls than the inflation; lines beside them
    # may be too.
    floor = np.minimum(clearance.at(points), level)
    kept = _straightened(
        clearance.field.table, clearance.known, clearance.discs, points, spent, floor, stride, robot_radius
    )
    return points[kept]


@compiled
def _straightened(
    table: Array,
    free: BoolArray,
    discs: Array,
    points: Array,
    spent: Array,
    floor: Array,
    stride: int,
    robot_radius: float,
) -> IntArray:
    """Indices of the points (n, 2) that are left: from each the farthest that a good line leads to."""
    last = len(points) - 1
    kept, count, anchor = np.zeros(last + 1, dtype=np.int64), 1, 0
    while anchor < last:
        farthest = anchor + 1  # the path itself
        for k in range(_LOOKAHEAD, 0, -1):
            end = min(anchor + stride * k, last)
            if k > 1 and end == min(anchor + stride * (k - 1), last):
                continue
            if _good_line(table, free, discs, points, spent, floor, anchor, end, robot_radius):
                farthest = end
                break
        anchor = farthest
        kept[count] = anchor
        count += 1
    return kept[:count]


@compiled
def _good_line(
    table: Array,
    free: BoolArray,
    discs: Array,
    points: Array,
    spent: Array,
    floor: Array,
    begin: int,
    end: int,
    robot_radius: float,
) -> bool:
    """Return True if a straight line keeps the clearance of its ends, stays on free cells, and costs no more."""
    across, along = points[end, 0] - points[begin, 0], points[end, 1] - points[begin, 1]
    length, allowed, total = math.hypot(across, along), min(floor[begin], floor[end]) - 1e-9, 0.0
    pieces = max(1, 2 * math.ceil(length * math.hypot(table[0], table[3])))  # half a cell each
    for k in range(pieces + 1):
        x, y = points[begin, 0] + k / pieces * across, points[begin, 1] + k / pieces * along
        column = math.floor(table[0] * x + table[1] * y + table[2])
        row = math.floor(table[3] * x + table[4] * y + table[5])
        if row < 0 or row >= free.shape[0] or column < 0 or column >= free.shape[1] or not free[row, column]:
            return False
        distance = _nearest(table, discs, x, y)[0]
        if distance < allowed:
            return False
        lacking = min(max((robot_radius + _WIDE - distance) / _WIDE, 0.0), 1.0)
        total += 1.0 + _PENALTY * lacking * lacking
    most = 1.001 * (spent[end] - spent[begin]) + 1e-9
    return bool(length * total / (pieces + 1) <= most)


@compiled
def _diffuse(table: Array, free: BoolArray, discs: Array, points: Array, preferred: float, sweeps: int) -> None:
    """Diffuse the corners of points (n, 2) away, in place; near walls a step keeps the part that does not approach."""
    count = len(points)
    known = np.empty((count, 3))
    for i in range(count):
        known[i, 0], known[i, 1], known[i, 2] = _nearest(table, discs, points[i, 0], points[i, 1])
    before = np.empty_like(points)
    for _ in range(sweeps):
        before[:] = points
        for i in range(1, count - 1):
            step_x = 0.25 * (before[i + 1, 0] - 2.0 * before[i, 0] + before[i - 1, 0])
            step_y = 0.25 * (before[i + 1, 1] - 2.0 * before[i, 1] + before[i - 1, 1])
            distance, slope_x, slope_y = known[i]
            slope = slope_x * step_x + slope_y * step_y
            if distance <= preferred + 0.01 and slope < 0.0:
                slope /= max(slope_x * slope_x + slope_y * slope_y, 1e-12)
                step_x, step_y = step_x - slope * slope_x, step_y - slope * slope_y
            x, y = before[i, 0] + step_x, before[i, 1] + step_y
            column = math.floor(table[0] * x + table[1] * y + table[2])
            row = math.floor(table[3] * x + table[4] * y + table[5])
            if row < 0 or row >= free.shape[0] or column < 0 or column >= free.shape[1] or not free[row, column]:
                continue
            trial, trial_x, trial_y = _nearest(table, discs, x, y)
            if trial >= min(distance, preferred) - 1e-12:
                points[i, 0], points[i, 1] = x, y
                known[i, 0], known[i, 1], known[i, 2] = trial, trial_x, trial_y


@compiled
def _leave_corners(table: Array, discs: Array, points: Array, level: float) -> None:
    """Undo the millimetres by which the chords of the last resampling cut a corner below the inflation, in place."""
    for _ in range(4):
        for i in range(1, len(points) - 1):
            distance, slope_x, slope_y = _nearest(table, discs, points[i, 0], points[i, 1])
            lacking = level - distance
            # Larger gaps are the stubs at start and goal, which may lie nearer to a wall than the inflation.
            if 0.0 < lacking < 0.01:
                move = (lacking + 1e-9) / max(slope_x * slope_x + slope_y * slope_y, 0.25)
                points[i, 0] += move * slope_x
                points[i, 1] += move * slope_y
