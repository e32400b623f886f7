"""Ways of robots whose heading matters: of cars, and of bodies that are no disc about their axis.

Hybrid A* (Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous vehicles in unknown semi-structured
environments", 2010): motions that the base can make lead from one pose to the next, and of all that end in a cell of
place and heading the cheapest is kept, with its pose. The search runs from the goal, which it meets exactly, back to
the start, guided by the way of a point on the grid. Clearances are those of the body's discs on the smoothed field that
the controller keeps to.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2
from unifg.models.distance_map import DistanceMap, SmoothField, smooth
from unifg.models.footprint import Body
from unifg.models.planar import Base
from unifg.scenarios.planning.grid import SPACING, Clearance, cost_per_metre, finished, is_free, plain, searching
from unifg.scenarios.planning.heap import pop, push
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["motions", "plan_poses"]

CELL = 0.1  # [m]
HEADINGS = 48  # cells of heading
STRIDE = 0.2  # [m], length of a motion
TIGHT = 0.9  # of the greatest curvature, so that a controller has some to spare
CURVED = 2.0  # [1/m], greatest curvature of a base that turns on the spot
LEVER = 1.0  # [m/rad]; a turn takes as long as this way at full speed
BACKWARDS, ASIDE, TURNING = 1.5, 1.5, 2.0  # cost of a metre in reverse, sideways, and turned on the spot
SWITCH, BEND = 0.5, 0.04  # [m], cost of another sense, and of another curvature
COMFORT = (0.12, 0.06, 0.03, 0.0)  # [m] beyond the least gap, tried in this order
NEAR = 0.4  # [m] from start and goal, where as much clearance as there will do
TOUCHING = 0.005  # [m], less than that is none
BESIDE = (0.12, 0.15)  # [m, rad] from the start, where the search ends
GUIDED = 0.95  # of the grid's cost that guides: its ways have eight directions
MOST = 4_000_000  # poses tried
LARGEST = 500_000_000  # cells of place and heading


def motions(base: Base) -> tuple[Array, IntArray, Array]:
    """Motions of a base from the identity.

    Returns:
        (M, S, 3) poses along each [m, m, rad], of which so many (M,) are used, `SPACING` apart as the robot needs time
        for them; and (M, 3) the sense (1 ahead, -1 in reverse, 2 and -2 sideways, 0 on the spot), the curvature [1/m]
        and the cost of each.
    """
    greatest = TIGHT / base.turning_radius if base.turning_radius else CURVED
    bends = [share * greatest for share in (0.0, 0.5, -0.5, 1.0, -1.0)]
    found = [(sense, bend, (sense * STRIDE, 0.0, sense * STRIDE * bend)) for sense in (1, -1) for bend in bends]
    if base.turning_radius == 0.0:
        found += [(0, turn, (0.0, 0.0, turn * 2.0 * math.pi / HEADINGS)) for turn in (1.0, -1.0)]
    if base.slides:
        found += [(2 * side, 0.0, (0.0, side * STRIDE, 0.0)) for side in (1, -1)]
    lengths = [max(math.hypot(x, y), LEVER * abs(turn)) for _, _, (x, y, turn) in found]
    count = np.array([max(2, math.ceil(length / SPACING - 1e-9)) for length in lengths])
    poses, about = np.zeros((len(found), count.max(), 3)), np.zeros((len(found), 3))
    for k, (sense, bend, tangent) in enumerate(found):
        shares = np.arange(1, count[k] + 1) / count[k]
        poses[k, : count[k]] = SE2.exp(shares[:, None] * np.array(tangent))
        factor = {1: 1.0, -1: BACKWARDS, 0: TURNING}.get(sense, ASIDE)
        about[k] = sense, bend, factor * max(math.hypot(*tangent[:2]), LEVER * abs(tangent[2]) * (sense == 0))
    return poses, count, about


def plan_poses(
    occupancy: OccupancyMap,
    distance_map: DistanceMap,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    base: Base,
    body: Body,
    gap: float,
    extra_discs: ArrayLike | None = None,
) -> Array:
    """Poses (P, 3) [m, m, rad] from a start to a goal (3,) that a base can drive and a body has room for.

    They are `SPACING` apart in the time that the robot needs, as metres at full speed.

    Args:
        occupancy: the map; only its free cells are entered.
        distance_map: its signed distance.
        start: (3,) [m, m, rad]; the first motion begins beside it.
        goal: (3,) [m, m, rad], the last pose.
        base: that moves.
        body: of the robot.
        gap: least distance of the hull to walls and discs [m].
        extra_discs: (K, 3) x, y, radius [m] of obstacles that are not on the map.

    Raises:
        ScenarioError: the body does not fit at the start or at the goal, or there is no way.
    """
    ends = np.array([start, goal], dtype=np.float64)
    clearance = Clearance(occupancy, distance_map, extra_discs, body.radius)
    field, discs = SmoothField(distance_map), clearance.discs
    places = body.places(ends)
    distance = field.distance(places)
    for x, y, radius in discs.tolist():
        distance = np.minimum(distance, np.hypot(places[..., 0] - x, places[..., 1] - y) - radius)
    room = np.minimum((distance + body.smaller).min(axis=1) - body.radius, gap + COMFORT[0])
    for name, pose, has in zip(("start", "goal"), ends, room.tolist(), strict=True):
        if has < TOUCHING or not is_free(occupancy, pose[:2]):
            raise ScenarioError(
                f"planner: at the {name} ({pose[0]:.2f}, {pose[1]:.2f}, {pose[2]:.2f}) the body has {has:.3f} m to the "
                f"nearest wall or obstacle of map {occupancy.name!r}, or is not in its free space; choose another pose"
            )
    shape = np.ceil(np.array(occupancy.shape) * (occupancy.resolution / CELL)).astype(np.int64)
    if shape.prod() * HEADINGS > LARGEST:
        raise ScenarioError(f"planner: map {occupancy.name!r} is too large for a search with headings; cut it")
    prices = plain(cost_per_metre(clearance.grid, body.radius))
    inner = max(-float(body.gap(np.zeros(2))), 0.0) + gap
    cells = clearance.known & (clearance.grid >= min(inner, inner + float(room[0]) - gap) - occupancy.resolution)
    begin = np.floor(occupancy.world_to_grid(ends[0, :2])).astype(np.int64)[::-1]
    _, guide = finished(searching(plain(cells), prices, np.array([-1, -1]), plain(begin)))
    guide *= GUIDED * occupancy.resolution
    for comfort in COMFORT:
        chain = _hybrid(
            distance_map.table, clearance.known, discs, np.array(body.discs), gap + comfort, ends, room,
            *motions(base), prices, guide, shape, occupancy.resolution / CELL,
        )  # fmt: skip
        if len(chain):
            return np.concatenate([ends[:1], chain])
    raise ScenarioError(
        f"planner: no way from ({ends[0, 0]:.2f}, {ends[0, 1]:.2f}) to ({ends[1, 0]:.2f}, {ends[1, 1]:.2f}) through "
        f"the free space of map {occupancy.name!r} for this base and body that keeps {gap:.2f} m from walls; choose "
        "another goal, or a map without the wall, gap or unknown area between them"
    )


@compiled
def _composed(pose: Array, x: float, y: float, turn: float) -> tuple[float, float, float]:
    """A pose seen from another one."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    heading = (pose[2] + turn + math.pi) % (2.0 * math.pi) - math.pi
    return pose[0] + cosine * x - sine * y, pose[1] + sine * x + cosine * y, heading


@compiled
def _fits(
    table: Array, known: BoolArray, discs: Array, parts: Array, gap: float, ends: Array, room: Array, x: float,
    y: float, heading: float,
) -> bool:  # fmt: skip
    """True if the body keeps the gap at a pose, or near start and goal what it keeps there."""
    least = gap
    for k in range(2):
        if math.hypot(x - ends[k, 0], y - ends[k, 1]) < NEAR:
            least = min(least, room[k])
    cosine, sine = math.cos(heading), math.sin(heading)
    for k in range(len(parts)):
        across, along = x + cosine * parts[k, 0] - sine * parts[k, 1], y + sine * parts[k, 0] + cosine * parts[k, 1]
        column = math.floor(table[0] * across + table[1] * along + table[2])
        row = math.floor(table[3] * across + table[4] * along + table[5])
        if row < 0 or row >= known.shape[0] or column < 0 or column >= known.shape[1] or not known[row, column]:
            return False
        distance = smooth(table, across, along)[0]
        for m in range(len(discs)):
            distance = min(distance, math.hypot(across - discs[m, 0], along - discs[m, 1]) - discs[m, 2])
        if distance < parts[k, 2] + least - 1e-9:
            return False
    return True


@compiled
def _hybrid(
    table: Array, known: BoolArray, discs: Array, parts: Array, gap: float, ends: Array, room: Array, along: Array,
    count: IntArray, about: Array, prices: Array, guide: Array, shape: IntArray, coarse: float,
) -> Array:  # fmt: skip
    """Poses (P, 3) from beside the start to the goal; none where there is no way."""
    best = np.full(shape[0] * shape[1] * HEADINGS, -1, dtype=np.int32)
    pose, spent = np.empty((MOST, 3)), np.empty(MOST)
    parent, via, done = np.empty(MOST, np.int64), np.empty(MOST, np.int64), np.zeros(MOST, np.bool_)
    keys, places = np.empty(MOST), np.empty(MOST, dtype=np.int64)
    pose[0, 0], pose[0, 1], pose[0, 2] = ends[1, 0], ends[1, 1], ends[1, 2]
    spent[0], parent[0], via[0], nodes = 0.0, -1, -1, 1
    size, found = push(keys, places, 0, 0.0, 0), -1
    while size > 0 and nodes + len(count) < MOST:
        here = pop(keys, places, size)
        size -= 1
        if done[here]:
            continue
        done[here] = True
        turned = (pose[here, 2] - ends[0, 2] + math.pi) % (2.0 * math.pi) - math.pi
        if math.hypot(pose[here, 0] - ends[0, 0], pose[here, 1] - ends[0, 1]) < BESIDE[0] and abs(turned) < BESIDE[1]:
            found = here
            break
        for m in range(len(count)):
            end = along[m, count[m] - 1]
            cosine, sine = math.cos(end[2]), math.sin(end[2])
            x, y, heading = _composed(
                pose[here], -cosine * end[0] - sine * end[1], sine * end[0] - cosine * end[1], -end[2]
            )
            pose[nodes, 0], pose[nodes, 1], pose[nodes, 2] = x, y, heading
            column = math.floor(table[0] * x + table[1] * y + table[2])
            row = math.floor(table[3] * x + table[4] * y + table[5])
            if row < 0 or row >= known.shape[0] or column < 0 or column >= known.shape[1]:
                continue
            ahead = guide[row * known.shape[1] + column]
            if not ahead < np.inf:
                continue
            cost = spent[here] + about[m, 2] * prices[row, column]
            after = via[here]
            if after >= 0:
                cost += SWITCH * (about[after, 0] != about[m, 0]) + BEND * abs(about[after, 1] - about[m, 1])
            angle = int((heading + math.pi) / (2.0 * math.pi) * HEADINGS) % HEADINGS
            place = (int(row * coarse) * shape[1] + int(column * coarse)) * HEADINGS + angle
            other = best[place]
            if other >= 0 and (done[other] or spent[other] <= cost):
                continue
            free = _fits(table, known, discs, parts, gap, ends, room, x, y, heading)
            for j in range(count[m] - 1):
                if not free:
                    break
                x, y, heading = _composed(pose[nodes], along[m, j, 0], along[m, j, 1], along[m, j, 2])
                free = _fits(table, known, discs, parts, gap, ends, room, x, y, heading)
            if free:
                best[place], spent[nodes], parent[nodes], via[nodes] = nodes, cost, here, m
                size = push(keys, places, size, cost + ahead, nodes)
                nodes += 1
    total, here = 0, found
    while here > 0:
        total += count[via[here]]
        here = parent[here]
    chain = np.empty((total, 3))
    total, here = 0, found
    while here > 0:
        m = via[here]
        for j in range(count[m]):
            chain[total, 0], chain[total, 1], chain[total, 2] = _composed(
                pose[here], along[m, j, 0], along[m, j, 1], along[m, j, 2]
            )
            total += 1
        here = parent[here]
    return chain
