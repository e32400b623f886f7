"""Pose graphs in whichever format a file has."""

from __future__ import annotations

from pathlib import Path

from unifg.files.contents import LIMITS, Limits
from unifg.files.g2o import parse_g2o
from unifg.files.tagged import TaggedFile
from unifg.files.toro import parse_toro
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import PoseGraph

__all__ = ["read_pose_graph"]


TORO = ("VERTEX2", "VERTEX3", "EDGE2", "EDGE3")  # tags that nobody else has


def read_pose_graph(path: str | Path, limits: Limits = LIMITS, *, repair: Repair | None = None) -> PoseGraph:
    """Read a pose graph in the g2o or TORO format, told apart by their tags and not by the name of the file.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.
        repair: what to do about indefinite information; see `unifg.pose_graphs.repaired`. By default it stays.

    Raises:
        FileFormatError: as `unifg.files.g2o.read_g2o` and `unifg.files.toro.read_toro`.
    """
    file = TaggedFile.read(path, limits)
    parse = parse_toro if any(tag in file for tag in TORO) else parse_g2o
    return parse(file, repair)
