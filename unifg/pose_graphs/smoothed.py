"""The pose graph that an incremental smoother holds, so that its map can be judged while it grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unifg.errors import GraphError, require_kinds
from unifg.lie import SE2, SE3, Rn
from unifg.modeling.factors import ManifoldResidual, between, prior
from unifg.pose_graphs.pose_graph import SEEN, Edges, PoseGraph, Priors, Sightings
from unifg.smoothing.contents import Held, contents
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.incremental import Incremental
from unifg.solvers import GaussNewton
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["from_smoother"]

FEW = 10  # Gauss-Newton iterations


def from_smoother(smoother: Incremental) -> tuple[PoseGraph, BoolArray]:
    """Pose graph of what a smoother holds, and which of its edges count.

    ``graph.verdict(used=used)`` judges the map. Poses and landmarks are those of least squares, to which one or two
    Gauss-Newton steps lead from the estimates. Identifiers of poses are members, those of landmarks go on after them.
    Edges are in the order in which they were stated. Those that revocable decisions leave out do not count; sightings
    and priors that they leave out are not in the graph. A prior that is the only one says nothing but where the map
    lies: the graph has a known pose in its place.

    Args:
        smoother: with one family of poses in SE2 or SE3, at most one of landmarks, and `between` for pairs of poses,
            `prior` for poses, `sighting`, `bearing`, `distance` and `bearing_range` for landmarks, without losses.

    Returns:
        The graph, and (m,) True for edges that count.

    Raises:
        GraphError: naming the factor or family that has no place in a pose graph; an update failed; the smoother is
            another one, as one that forgets.
    """
    require_kinds("from_smoother", GraphError, from_smoother.__annotations__, {"smoother": smoother}, Incremental)
    x = _family(smoother, "poses in SE2 or SE3", (SE2, SE3))
    if x is None:
        raise GraphError("from_smoother: the smoother has no family of poses in SE2 or SE3")
    group, dim = x.manifold, x.manifold.dim
    points = Rn(SE3.point_dim if group == SE3 else SE2.point_dim)
    places = _family(smoother, f"landmarks in {points.name}", (points,))
    kernels = [("edges", between.on(group).kernel, [x, x]), ("pose", prior.on(group).kernel, [x])]
    for kind, function in SEEN.items():
        seen = function.on(group) if isinstance(function, ManifoldResidual) else function
        kernels += [] if places is None else [(kind, seen.kernel, [x, places])]
    found: dict[str, list[Held]] = {}
    for held in contents(smoother):
        fitting = (
            kind
            for kind, kernel, families in kernels
            if held.has(kernel) and (held.families == [family.number for family in families]).all()
        )
        kind = next(fitting, "") if held.plain else ""
        if not kind:
            name = "a Python function" if held.kernel is None else f"'{held.kernel.name}'"
            numbers = zip(held.families[0].tolist(), held.members[0].tolist(), strict=True)
            names = [family.name for family in smoother.families.values()]
            about = ", ".join(f"{names[number]}[{member}]" for number, member in numbers)
            loss = "" if held.plain else ", with a robust loss"
            raise GraphError(
                f"from_smoother: {name} of {about}{loss} has no place in a pose graph, which takes plain squares of "
                f"between and prior of {x.name} and of sightings of landmarks"
            )
        found.setdefault(kind, []).append(held)
    first_second, measured, information, used = _joined(found.pop("edges", []), 2, group.storage, dim)
    edges = Edges(first_second[:, 0], first_second[:, 1], measured, information)
    priors, fixed = dict[str, Priors](), tuple[int, ...]()
    if "pose" in found:
        where, measured, information, kept = _joined(found.pop("pose"), 1, group.storage, dim)
        held_poses = Priors(where[:, 0], measured, information)[kept]
        if len(held_poses) == 1 and np.linalg.matrix_rank(held_poses.information[0], hermitian=True) == dim:
            fixed = (int(held_poses.pose[0]),)
        elif len(held_poses):
            priors["pose"] = held_poses
    sightings = dict[str, Sightings]()
    for kind, several in found.items():
        ends, measured, information, kept = _joined(several, 2, 0, 0)
        if kept.any():
            sightings[kind] = Sightings(ends[:, 0], ends[:, 1], measured, information)[kept]
    landmarks = np.zeros((0, points.dim)) if places is None else smoother.estimate(places, best=True)
    graph = PoseGraph(
        np.arange(x.count), smoother.estimate(x, best=True), edges, x.count + np.arange(len(landmarks)), landmarks,
        sightings, fixed, priors=priors,
    )  # fmt: skip
    counting = replace(graph, edges=edges[used])
    stated, poses, guess = counting.graph()
    solution = GaussNewton(max_iterations=FEW).solve(stated, guess)
    solved = graph.with_poses(solution[poses], None if places is None else solution[stated.families["landmarks"]])
    return solved if 2.0 * solution.cost < counting.chi2() else graph, used


def _family(smoother: Incremental, what: str, manifolds: tuple[object, ...]) -> GrowingFamily | None:
    """Family on one of some manifolds, or nothing; refuse several."""
    found = [family for family in smoother.families.values() if family.manifold in manifolds]
    if len(found) > 1:
        raise GraphError(f"from_smoother: found families {[each.name for each in found]}, expected one of {what}")
    return found[0] if found else None


def _joined(parts: list[Held], ends: int, storage: int, dim: int) -> tuple[IntArray, Array, Array, BoolArray]:
    """Members (k, ends), measurements (k, storage), information (k, dim, dim), and which count, in their order."""
    if not parts:
        empty = np.zeros((0, ends), dtype=np.int64), np.zeros((0, storage)), np.zeros((0, dim, dim))
        return *empty, np.zeros(0, dtype=np.bool_)
    order = np.argsort(np.concatenate([part.order for part in parts]))
    fields = ("members", "parameters", "information", "accepted")
    members, measured, information, accepted = (
        np.concatenate([getattr(part, name) for part in parts])[order] for name in fields
    )
    return members, measured, information, accepted
