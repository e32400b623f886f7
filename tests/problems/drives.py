"""Long drives with few loop closures: odometry that drifts slowly, information that is cautious for all but that."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from unifg.lie import SE2
from unifg.pose_graphs import Edges, PoseGraph, odometric
from unifg.typing import Array, BoolArray, IntArray

INFORMATION = np.array([[554.0, -36.0, -388.0], [-36.0, 388.0, 525.0], [-388.0, 525.0, 294517.0]])
BLOCK = 40  # [m] between crossings
STEADY = 200  # [m] over which the drift of odometry stays what it is
DRIFT = np.array([0.01, 0.002, 0.0004])  # [m, m, rad] in a step


@dataclass(frozen=True)
class Kind:
    """Sizes of errors.

    Attributes:
        drift: of odometry, times `DRIFT`.
        white: of odometry, in stated standard deviations.
        noise: of loop closures, likewise.
        tail: share of the closures with more of it.
        tail_noise: how much they have.
        closures: their number, at most.
        count: poses.
    """

    drift: float = 1.0
    white: float = 0.1
    noise: float = 0.2
    tail: float = 0.05
    tail_noise: float = 1.0
    closures: int = 100
    count: int = 1500


def drive(seed: int, kind: Kind) -> tuple[PoseGraph, Array]:
    """A drive through streets in steps of a metre, its poses those of odometry; and the true poses."""
    rng, count = np.random.default_rng(seed), kind.count
    side = max(2, round((count / (3.0 * BLOCK)) ** 0.5))
    cells = np.zeros((count, 3), dtype=int)  # x and y [m], heading in quarter turns
    cells[0, :2] = BLOCK * (side // 2)
    steps = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for k in range(1, count):
        x, y, heading = cells[k - 1].tolist()
        if x % BLOCK == 0 and y % BLOCK == 0:
            ahead = {turn: cells[k - 1, :2] + steps[(heading + turn) % 4] for turn in (0, 1, -1)}
            turns = [turn for turn, place in ahead.items() if (place >= 0).all() and (place <= BLOCK * side).all()]
            heading = (heading + turns[int(rng.integers(len(turns)))]) % 4
        cells[k] = [*(cells[k - 1, :2] + steps[heading]), heading]
    truth = np.column_stack([cells[:, :2] - cells[0, :2], cells[:, 2] * np.pi / 2]).astype(float)
    first: dict[tuple[int, ...], int] = {}
    found = []
    for k, cell in enumerate(map(tuple, cells.tolist())):
        before = first.setdefault(cell, k)
        if k - before > 60:
            found.append((before, k))
            first[cell] = k
    pairs = np.array(found)
    if len(pairs) > kind.closures:
        pairs = pairs[np.sort(rng.choice(len(pairs), kind.closures, replace=False))]
    along = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    spread = np.linalg.cholesky(np.linalg.inv(INFORMATION)).T
    kept = np.exp(-1.0 / STEADY)
    slow, fresh = np.zeros((count - 1, 3)), rng.standard_normal((count - 1, 3)) * np.sqrt(1.0 - kept**2)
    for k in range(count - 1):
        slow[k] = (kept * slow[k - 1] if k else 0.0) + fresh[k]
    seen = SE2.between(truth[along[:, 0]], truth[along[:, 1]])
    seen = SE2.retract(seen, kind.white * rng.standard_normal((count - 1, 3)) @ spread + kind.drift * DRIFT * slow)
    again = SE2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    size = np.where(rng.random(len(pairs)) < kind.tail, kind.tail_noise, kind.noise)
    again = SE2.retract(again, size[:, None] * (rng.standard_normal((len(pairs), 3)) @ spread))
    ends, measured = np.concatenate([along, pairs]), np.concatenate([seen, again])
    edges = Edges(ends[:, 0], ends[:, 1], measured, np.tile(INFORMATION, (len(ends), 1, 1)))
    graph = PoseGraph(np.arange(count), truth, edges)
    return graph.with_poses(odometric(graph)), truth


def slipped(graph: PoseGraph, seed: int) -> tuple[PoseGraph, IntArray]:
    """Three steps of odometry that are wrong by metres, with poses along the rest of it; and which those are."""
    rng = np.random.default_rng(seed)
    which = rng.choice(np.flatnonzero(graph.edges.odometry), 3, replace=False)
    measured = graph.edges.measured.copy()
    measured[which] = SE2.retract(measured[which], rng.uniform(-1.0, 1.0, (3, 3)) * np.array([8.0, 3.0, 0.6]))
    wrong = replace(graph, edges=replace(graph.edges, measured=measured))
    return wrong.with_poses(odometric(wrong)), which


def aliased(graph: PoseGraph, truth: Array, seed: int, miss: tuple[float, ...]) -> tuple[PoseGraph, BoolArray]:
    """Fifteen closures that say that one street is another: all wrong by one motion; and (m,) which edges those are."""
    rng, count = np.random.default_rng(seed), len(truth)
    first = int(rng.integers(50, count // 3)) + np.arange(15)
    second = int(rng.integers(2 * count // 3, count - 60)) + np.arange(15)
    move = SE2.compose(SE2.compose(truth[first[:1]], SE2.exp(np.array([miss]))), SE2.inverse(truth[first[:1]]))
    seen = SE2.compose(SE2.inverse(truth[first]), SE2.compose(np.repeat(move, 15, axis=0), truth[second]))
    spread = np.linalg.cholesky(np.linalg.inv(INFORMATION)).T
    measured = SE2.compose(seen, SE2.exp(0.2 * rng.standard_normal((15, 3)) @ spread))
    edges = graph.edges
    every = Edges(
        np.concatenate([edges.first, first]),
        np.concatenate([edges.second, second]),
        np.concatenate([edges.measured, measured]),
        np.concatenate([edges.information, np.tile(INFORMATION, (15, 1, 1))]),
    )
    return replace(graph, edges=every), np.arange(len(every)) >= len(edges)
