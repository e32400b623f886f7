"""Paths around discs in the plane: one start of a solver for each side on which what blocks the way can be passed.

Two paths with the same ends that pass a point on different sides differ by a whole turn in their winding about it, and
no continuous change that keeps off the point leads from one to the other (S. Bhattacharya, M. Likhachev and V. Kumar,
"Topological constraints in search-based robot path planning", 2012). A local solver stays in the class of its start.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from unifg.errors import ModelError, require_kinds, require_positive
from unifg.modeling.duplicates import doubles
from unifg.typing import Array, ArrayLike

__all__ = ["detours", "headed"]

MOST_BLOCKING = 3  # discs whose sides are chosen: those that reach farthest across the way


def detours(
    start: ArrayLike,
    goal: ArrayLike,
    centres: ArrayLike,
    radii: ArrayLike,
    steps: int,
    stride: float,
    most: int = 2,
) -> list[Array]:
    """Positions (N + 1, 2) along paths on either side of the discs that block the straight one, the shortest first.

    Paths touch the discs they pass, and may cut others: they are guesses for a solver. Where nothing blocks the way
    there is one path, the straight one.

    Args:
        start: (2,) [m].
        goal: (2,) [m].
        centres: (M, 2) of the discs, or of points to be passed [m].
        radii: (M,) or one for all, with the robot's [m].
        steps: N.
        stride: greatest distance between two positions [m]; who arrives early waits at the goal.
        most: number of paths.

    Raises:
        ModelError: for arrays that do not fit or are not finite, radii below zero, no step, no path, or a stride that
            is not positive.
    """
    require_kinds("detours", ModelError, detours.__annotations__, {"steps": steps, "most": most})
    require_positive("detours", ModelError, stride=stride, steps=steps, most=most)
    given = {"start and goal": [start, goal], "centres": centres, "radii": radii}
    ends, middle, radius = (doubles(f"detours: {what}", part, error=ModelError) for what, part in given.items())
    middle = middle.reshape(-1, 2) if middle.size == 0 else middle
    fits = middle.ndim == 2 and middle.shape[1] == 2 and radius.ndim < 2 and radius.size in (1, len(middle))
    if ends.shape != (2, 2) or not (
        fits and (radius >= 0.0).all() and all(np.isfinite(part).all() for part in (ends, middle, radius))
    ):
        raise ModelError(
            "detours: start and goal must be (2,), and radii (M,), not negative, for centres (M, 2), all finite; got "
            f"{ends.tolist()}, {radii!r} and {middle.shape}"
        )
    radius = np.broadcast_to(radius, len(middle))
    length = max(float(np.hypot(*(ends[1] - ends[0]))), 1e-12)
    ahead = (ends[1] - ends[0]) / length
    aside = np.array([-ahead[1], ahead[0]])
    along, off = (middle - ends[0]) @ ahead, (middle - ends[0]) @ aside
    blocking = np.flatnonzero((np.abs(off) < radius) & (along > 0.0) & (along < length))
    blocking = blocking[np.argsort((np.abs(off) - radius)[blocking], kind="stable")][:MOST_BLOCKING]
    blocking = blocking[np.argsort(along[blocking], kind="stable")]
    passed = ends[0] + along[blocking, None] * ahead
    paths = []
    for sides in product((1.0, -1.0), repeat=len(blocking)):
        shift = off[blocking] + np.array(sides) * radius[blocking]
        corners = np.vstack([ends[:1], passed + shift[:, None] * aside, ends[1:]])
        gone = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        nodes = np.minimum(stride * np.arange(steps + 1.0), gone[-1])
        path = np.column_stack([np.interp(nodes, gone, corners[:, axis]) for axis in (0, 1)])
        paths.append((float(gone[-1]), path))
    return [path for _, path in sorted(paths, key=lambda found: found[0])[:most]]


def headed(path: ArrayLike, heading: float, backwards: bool = False) -> Array:
    """Poses (N + 1, 3) of a vehicle that follows positions (N + 1, 2).

    Args:
        path: positions [m].
        heading: where it does not move [rad].
        backwards: True for one that drives in reverse.

    Raises:
        ModelError: for less than two positions.
    """
    require_kinds("headed", ModelError, headed.__annotations__, {"heading": heading})
    positions = doubles("headed: the path", path, error=ModelError)
    if positions.ndim != 2 or positions.shape[1] != 2 or len(positions) < 2:
        raise ModelError(f"headed: two positions or more are expected, (N + 1, 2), found {positions.shape}")
    step = np.gradient(positions, axis=0)
    along = np.arctan2(step[:, 1], step[:, 0]) + (np.pi if backwards else 0.0)
    return np.column_stack([positions, np.where(np.hypot(*step.T) > 1e-9, along, heading)])
