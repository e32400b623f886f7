"""Arguments of ``unifg solve``; apart from `unifg.scenarios.pose_graph`, whose imports help does not need."""

from __future__ import annotations

import argparse
from pathlib import Path

from unifg.solvers import names

__all__ = ["DESCRIPTION", "add_arguments"]

DESCRIPTION = "Solve a pose graph from a file (g2o or TORO, gzipped or not)."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the file and the options of the solve, but not ``--out``."""
    parser.add_argument("file", type=_graph_file, metavar="GRAPH", help="pose graph: .g2o or .graph, also .gz")
    parser.add_argument(
        "--solver",
        choices=names.LEAST_SQUARES,
        default="gn",
        help=f"{names.choices(names.LEAST_SQUARES)} (default: %(default)s)",
    )
    parser.add_argument(
        "--robust",
        metavar="LOSS[:PARAM]",
        help="loss on loop closures: huber, cauchy, tukey, dcs, or gnc (truncated least squares, graduated)",
    )
    parser.add_argument(
        "--init",
        choices=("file", "odometry", "lago", "chordal"),
        default="file",
        help="first guess: poses of the file, a spanning tree, LAGO (2D) or chordal relaxation (default: %(default)s)",
    )
    parser.add_argument(
        "--residual",
        choices=("log", "g2o"),
        default="log",
        help="full logarithm, as GTSAM, or the chart of g2o; their optima differ in 3D (default: %(default)s)",
    )


def _graph_file(text: str) -> Path:
    path = Path(text)
    if not path.is_file():
        raise argparse.ArgumentTypeError(f"{text}: no such file; give a pose graph (g2o or TORO)")
    return path
