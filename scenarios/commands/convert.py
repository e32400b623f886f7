"""``unifg convert``: a pose graph or a trajectory in another format, told by the endings of the files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from unifg.errors import FileFormatError
from unifg.files.contents import legible, suffix_of
from unifg.files.euroc import read_euroc
from unifg.files.g2o import write_g2o
from unifg.files.kitti import read_kitti, write_kitti
from unifg.files.pose_graph import read_pose_graph
from unifg.files.toro import write_toro
from unifg.files.tum import Trajectory, read_tum, write_tum
from unifg.pose_graphs.pose_graph import PoseGraph
from unifg.typing import Array

__all__ = ["GRAPHS", "TRAJECTORIES", "convert"]

GRAPHS: dict[str, Callable[[Path, PoseGraph], Path]] = {".g2o": write_g2o, ".graph": write_toro}
"""Formats of pose graphs that can be written."""
TRAJECTORIES: dict[str, Callable[[Path, Array, Array], Path]] = {
    ".tum": write_tum,
    ".kitti": lambda path, time, poses: write_kitti(path, poses),
}
"""Formats of trajectories that can be written."""
_SOURCES = {".tum": "", ".csv": "; times are seconds from the first one"}  # what becomes of times


def convert(source: Path, target: Path) -> str:
    """Read one file and write the other; returns a sentence about what is in it.

    Sources are TUM (``.tum``), KITTI (``.kitti``) and EuRoC (``.csv``) trajectories, and in any other file pose graphs
    (g2o, TORO, GTSAM). A graph may become a trajectory, with the numbers of its poses as times; KITTI has no times, and
    those of EuRoC are written from the first pose.

    Raises:
        FileFormatError: the source cannot be read, the target's ending is none of these, or a trajectory is to become
            a graph.
    """
    ending = suffix_of(target)
    known = {**GRAPHS, **TRAJECTORIES}
    if ending not in known:
        raise FileFormatError(f"{legible(target)}: no format ends in '{ending}': choose {', '.join(known)}, also .gz")
    graph = None if suffix_of(source) in (".kitti", ".tum", ".csv") else read_pose_graph(source)
    if ending in TRAJECTORIES:
        time, poses = (_numbers(graph.poses), graph.poses) if graph else _read_trajectory(source)
        TRAJECTORIES[ending](target, time, poses)
        counted = {".kitti": "", ".tum": _SOURCES.get(suffix_of(source), "; their numbers are the times")}[ending]
        return f"{len(poses)} poses{counted}"
    if graph is None:
        raise FileFormatError(f"{legible(source)} is a trajectory: it has no measurements for {legible(target)}")
    GRAPHS[ending](target, graph)
    return f"{len(graph.poses)} poses, {len(graph.edges)} edges"


def _numbers(poses: Array) -> Array:
    """Numbers of poses, in the place of times."""
    return np.arange(len(poses), dtype=np.float64)


def _read_trajectory(path: Path) -> tuple[Array, Array]:
    """Times [s], or numbers where there are none, and poses (n, 7)."""
    if suffix_of(path) == ".kitti":
        poses = read_kitti(path)
        return _numbers(poses), poses
    found: Trajectory = (read_tum if suffix_of(path) == ".tum" else read_euroc)(path)
    return found.time, np.column_stack([found.position, found.quaternion_xyzw[:, 3:], found.quaternion_xyzw[:, :3]])
