"""Pose graphs in whichever format a file has."""

from __future__ import annotations

from pathlib import Path

from unifg.files.contents import LIMITS, Limits
from unifg.files.g2o import G2O
from unifg.files.measured import parse
from unifg.files.text import TextFile
from unifg.files.toro import TORO
from unifg.pose_graphs.information import Repair
from unifg.pose_graphs.pose_graph import PoseGraph

__all__ = ["read_pose_graph"]


def read_pose_graph(path: str | Path, limits: Limits = LIMITS, *, repair: Repair | None = None) -> PoseGraph:
    """Read a pose graph in the g2o or TORO format, told apart by their tags and not by the name of the file.

    Args:
        path: the file, gzipped or not.
        limits: of what it may hold.
        repair: what to do about indefinite information; see `unifg.pose_graphs.repaired`. By default it stays.

    Raises:
        FileFormatError: as `unifg.files.g2o.read_g2o` and `unifg.files.toro.read_toro`.
    """
    file = TextFile.read(path, limits)
    toro = any(form.pose in file or any(tag.name in file for tag in form.tags) for form in TORO)
    return parse(file, TORO if toro else G2O, repair)
