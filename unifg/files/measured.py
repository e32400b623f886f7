"""Checks of measurements read from pose graphs: indefinite weights, lines that repeat."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from unifg.errors import FileFormatError, GraphError
from unifg.files.tagged import TaggedFile
from unifg.modeling.summary import counted
from unifg.pose_graphs.information import Repair, indefinite, repaired, require_repair
from unifg.pose_graphs.initialise import odometric
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, Sightings
from unifg.typing import Array, IntArray

__all__ = ["Remarks", "placed_along", "vertices_of"]

logger = logging.getLogger("unifg")


class Remarks:
    """Sentences about the measurements of a file, each of which is logged once.

    Attributes:
        file: what is read.
        repair: what is done about indefinite information; None leaves it.
        sentences: so far.
    """

    def __init__(self, file: TaggedFile, repair: Repair | None) -> None:
        """Nothing has been said.

        Raises:
            GraphError: for a repair that there is not.
        """
        if repair is not None:
            require_repair(repair)
        self.file, self.repair = file, repair
        self.sentences: list[str] = []

    def say(self, sentence: str) -> None:
        """Keep and log a sentence."""
        self.sentences.append(sentence)
        logger.warning("%s: %s", self.file.path, sentence)

    def weights(self, what: str, information: Array, names: NDArray[np.int64], lines: IntArray) -> Array:
        """Information matrices (n, d, d) as they are to be used.

        Args:
            what: they belong to.
            information: (n, d, d).
            names: (n, 2) identifiers of what the measurements join.
            lines: (n,) where they stand.
        """
        wrong = np.flatnonzero(indefinite(information))
        if not len(wrong):
            return information
        places = ", ".join(f"line {lines[k]} ({names[k, 0]} - {names[k, 1]})" for k in wrong[:3].tolist())
        done = {
            None: "a graph refuses them; reading with repair='zero' leaves these out, 'project' keeps what is left",
            "zero": "set to zero: these measurements have no say",
            "project": "negative eigenvalues were set to zero",
        }[self.repair]
        self.say(
            f"{len(wrong)} of {len(information)} information matrices of {what} are indefinite: {places}"
            f"{', ...' if len(wrong) > 3 else ''}: {done}"
        )
        return information if self.repair is None else repaired(information, self.repair)

    def pairs(self, edges: Edges, ids: NDArray[np.int64], lines: IntArray) -> None:
        """Remark edges from a pose to itself, and edges that stand in the file twice, word by word."""
        own = np.flatnonzero(edges.first == edges.second)
        if len(own):
            k = int(own[0])
            joins = "joins its pose with itself" if len(own) == 1 else "join a pose with itself"
            self.say(f"{counted(len(own), 'edge')} {joins}, first in line {lines[k]} ({ids[edges.first[k]]})")
        keys = edges.first * (len(ids) + 1) + edges.second
        order = np.argsort(keys, kind="stable")
        before, after = order[:-1], order[1:]
        alike = keys[before] == keys[after]
        before, after = before[alike], after[alike]
        alike = (edges.measured[before] == edges.measured[after]).all(axis=1)
        alike &= (edges.information[before] == edges.information[after]).all(axis=(1, 2))
        twice = np.sort(after[alike])
        if len(twice):
            k = int(twice[0])
            pair = f"{ids[edges.first[k]]} - {ids[edges.second[k]]}"
            stand = "edge repeats another" if len(twice) == 1 else "edges repeat others"
            self.say(f"{len(twice)} {stand} word by word, first in line {lines[k]} ({pair}): each counts")


def vertices_of(file: TaggedFile, pairs: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Identifiers of the poses that measurements speak of, in rising order, for files without any vertex.

    Raises:
        FileFormatError: there is none.
    """
    found = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *pairs]))
    if not len(found):
        raise FileFormatError(f"{file.path}: neither poses nor edges between them")
    return found


def placed_along(file: TaggedFile, pose_graph: PoseGraph) -> PoseGraph:
    """A graph of measurements alone, its poses along a spanning tree, landmarks where they were first seen.

    Args:
        file: for messages.
        pose_graph: whose poses (n, 3) or (n, 7) are all the identity, and whose landmarks (k, 2) or (k, 3) mean nothing
            yet.

    Returns:
        The same graph, not `placed`: poses [m, rad, or unit quaternions], known ones or the first of each part at the
        identity; landmarks [m] where the first of their sightings puts them ("point" before "bearing-range"). Landmarks
        of which only bearings or ranges are known stay as they are.

    Raises:
        FileFormatError: a pose is joined to the others through landmarks only.
    """
    group = pose_graph.group
    try:
        poses = odometric(pose_graph)
    except GraphError as error:
        raise FileFormatError(f"{file.path}: there are no poses to start from, and {error}") from None
    landmarks = pose_graph.landmarks.copy()
    for kind in ("bearing-range", "point"):
        seen = pose_graph.sightings.get(kind)
        if seen is not None:
            chosen, first = np.unique(seen.landmark, return_index=True)
            landmarks[chosen] = group.act(poses[seen.pose[first]], _points(kind, seen)[first])
    return replace(pose_graph, poses=poses, landmarks=landmarks, placed=False)


def _points(kind: str, seen: Sightings) -> Array:
    """(k, p) where sightings see their landmarks, in the frame of the pose."""
    if kind == "point":
        return seen.measured
    bearing, distance = seen.measured.T
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
