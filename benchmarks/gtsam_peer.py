"""Pose graphs for GTSAM: the same measurements, start and anchor, timed iteration by iteration.

GTSAM puts rotation before translation in the tangent of SE(3); here it is the other way round. An iteration is
``optimizer.iterate()``, which linearises, eliminates, moves and evaluates the new error. Its wheel may bring a thread
pool: pin the process to one core (`benchmarks.timing.pin`).
"""

from __future__ import annotations

import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import clock
from unifg.lie import SE2
from unifg.pose_graphs import PoseGraph
from unifg.typing import Array

ORDERINGS = ("COLAMD", "METIS")
ANCHOR = 1e-3  # sigma of the prior on the first pose [m, rad]
ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def available() -> bool:
    """Test whether gtsam is installed."""
    return find_spec("gtsam") is not None


def planar_or_spatial(pose: Array) -> Any:
    """A Pose2 from x, y, heading, or a Pose3 from position and quaternion (scalar first)."""
    import gtsam

    if len(pose) == SE2.storage:
        return gtsam.Pose2(*pose)
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*pose[3:]), pose[:3])


def as_array(pose: Any) -> Array:
    """The inverse of :func:`planar_or_spatial`."""
    if hasattr(pose, "theta"):
        return np.array([pose.x(), pose.y(), pose.theta()])
    turned = pose.rotation().toQuaternion()
    return np.array([*pose.translation(), turned.w(), turned.x(), turned.y(), turned.z()])


class Peer:
    """A pose graph as GTSAM's factors.

    Attributes:
        pose_graph: what it was made from.
        graph: factors, with a prior on the first pose.
        start: values.
    """

    def __init__(self, pose_graph: PoseGraph) -> None:
        """Make the factors; keys are positions in the pose graph."""
        import gtsam

        planar = pose_graph.group is SE2
        between = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
        prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
        self.pose_graph = pose_graph
        self.graph: Any = gtsam.NonlinearFactorGraph()
        self.order = np.arange(3) if planar else ROTATION_FIRST
        edges = pose_graph.edges
        information = edges.information[:, self.order[:, None], self.order]
        for k in range(len(edges)):
            noise = gtsam.noiseModel.Gaussian.Information(information[k])
            measured = planar_or_spatial(edges.measured[k])
            self.graph.add(between(int(edges.first[k]), int(edges.second[k]), measured, noise))
        sigma = gtsam.noiseModel.Isotropic.Sigma(pose_graph.group.dim, ANCHOR)
        self.graph.add(prior(0, planar_or_spatial(pose_graph.poses[0]), sigma))
        self.start: Any = self.values(pose_graph.poses)

    def values(self, poses: Array) -> Any:
        """GTSAM's container of (n, storage) poses."""
        import gtsam

        values = gtsam.Values()
        for k, pose in enumerate(poses):
            values.insert(k, planar_or_spatial(pose))
        return values

    def optimizer(self, ordering: str) -> Any:
        """Gauss-Newton with default thresholds."""
        return _optimizer(self.graph, self.start, ordering)

    def iterate(self, ordering: str, count: int) -> float:
        """Mean time of ``count`` iterations from the start [s]."""
        optimizer = self.optimizer(ordering)
        return clock(lambda: [optimizer.iterate() for _ in range(count)]) / count

    def solve(self, ordering: str) -> tuple[float, int, float]:
        """Time of a whole solve from ordering to GTSAM's default thresholds [s], iterations and chi2."""
        begin = time.process_time()
        return _optimized(self.optimizer(ordering), begin)

    @staticmethod
    def solve_file(path: Path, spatial: bool, ordering: str) -> tuple[float, int, float]:
        """The same from a g2o file, read by GTSAM itself: time [s], iterations and chi2."""
        import gtsam

        begin = time.process_time()
        graph, start = gtsam.readG2o(str(path), spatial)
        prior: Any = gtsam.PriorFactorPose3 if spatial else gtsam.PriorFactorPose2
        first: Any = start.atPose3(0) if spatial else start.atPose2(0)
        graph.add(prior(0, first, gtsam.noiseModel.Isotropic.Sigma(6 if spatial else 3, ANCHOR)))
        return _optimized(_optimizer(graph, start, ordering), begin)

    def marginals(self, poses: Array) -> Any:
        """GTSAM's marginals at (n, storage) poses."""
        import gtsam

        return gtsam.Marginals(self.graph, self.values(poses))

    def marginals_of(self, jacobian: Array, anchor: Array) -> Any:
        """GTSAM's marginals of linear factors given to it, in the tangent they were made in.

        Args:
            jacobian: (m, d, 2 d) whitened derivatives of the edges.
            anchor: (d, d) of the prior on the first pose.
        """
        import gtsam

        edges, dim = self.pose_graph.edges, self.pose_graph.group.dim
        unit = gtsam.noiseModel.Unit.Create(dim)
        linear = gtsam.GaussianFactorGraph()
        for k, block in enumerate(jacobian):
            first, second = int(edges.first[k]), int(edges.second[k])
            by_first, by_second = np.asfortranarray(block[:, :dim]), np.asfortranarray(block[:, dim:])
            linear.add(gtsam.JacobianFactor(first, by_first, second, by_second, np.zeros(dim), unit))
        linear.add(gtsam.JacobianFactor(0, np.asfortranarray(anchor), np.zeros(dim), unit))
        return gtsam.Marginals(linear, self.start)

    def ours(self, covariance: Array) -> Array:
        """A covariance of one or several poses with translation before rotation."""
        back = np.argsort(self.order)
        count = len(covariance) // len(back)
        order = (len(back) * np.arange(count)[:, None] + back).ravel()
        return np.asarray(covariance[order[:, None], order])


def _optimizer(graph: Any, start: Any, ordering: str) -> Any:
    import gtsam

    parameters = gtsam.GaussNewtonParams()
    parameters.setOrderingType(ordering)
    return gtsam.GaussNewtonOptimizer(graph, start, parameters)


def _optimized(optimizer: Any, begin: float) -> tuple[float, int, float]:
    """Time since the beginning [s], iterations and chi2, at the optimum."""
    optimizer.optimize()
    return time.process_time() - begin, int(optimizer.iterations()), 2.0 * optimizer.error()


def joint(marginals: Any, first: int, second: int) -> Array:
    """Joint covariance of two poses, in GTSAM's order of the tangent."""
    found = marginals.jointMarginalCovariance([first, second])
    return np.block([[found.at(a, b) for b in (first, second)] for a in (first, second)])
