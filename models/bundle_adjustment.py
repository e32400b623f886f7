"""Bundle adjustment: cameras that look at points, as the problems of "Bundle Adjustment in the Large" state it.

S. Agarwal, N. Snavely, S. Seitz, R. Szeliski, "Bundle adjustment in the large", ECCV 2010: a pose takes points of the
world into the frame of the camera, which looks along its negative z axis with x to the right and y up. Pixels are
counted from the centre of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.errors import GraphError
from unifg.factors.robust import Loss
from unifg.lie import SE3, Rn
from unifg.modeling.factors import prior
from unifg.modeling.variables import Family
from unifg.solution.graph import Graph
from unifg.typing import Array, IntArray

__all__ = ["BundleAdjustment", "project", "reprojection", "triangulate"]

UNDISTORTED = 20  # steps of Newton's method that take the distortion out of a pixel
HELD = 1e-3  # of the angle of sigma: how firmly a distance is kept, relatively; firmer, it drowns the pixels


@dataclass(frozen=True, eq=False)
class BundleAdjustment:
    """Observations of points by cameras, and first values of both.

    Attributes:
        camera, point: (n,) camera and point of each observation.
        pixels: (n, 2) observed, from the centre of the image, x to the right and y up.
        poses: (C, 7) of `unifg.SE3`, from the world to the camera.
        intrinsics: (C, 3) focal length [pixels] and two coefficients of radial distortion.
        points: (P, 3) in the unit of the poses.
    """

    camera: IntArray
    point: IntArray
    pixels: Array
    poses: Array
    intrinsics: Array
    points: Array

    def graph(
        self, *, sigma: float = 1.0, robust: Loss | None = None, calibrated: bool = False
    ) -> tuple[Graph, dict[Family, Array]]:
        """State the factor graph.

        The first camera is fixed, and its distance to the one that is farthest kept, since pixels say nothing of place
        and scale.

        Args:
            sigma: standard deviation of both coordinates of a pixel.
            robust: loss on the observations.
            calibrated: keep the intrinsics as they are.

        Returns:
            The graph with the families ``poses``, ``intrinsics`` and ``points``, and a guess of the present values.

        Raises:
            GraphError: there are fewer than two cameras in different places.
        """
        centres = SE3.inverse(self.poses)[:, :3]
        far = np.linalg.norm(centres - centres[:1], axis=1)
        if not far.max(initial=0.0) > 0.0:
            raise GraphError("bundle adjustment needs two cameras in different places at least")
        graph, other = Graph(), int(far.argmax())
        poses = graph.variables("poses", SE3, len(self.poses))
        intrinsics = graph.variables("intrinsics", Rn(3), len(self.intrinsics))
        points = graph.variables("points", Rn(3), len(self.points))
        graph.fix(poses[0], self.poses[0], name="first camera")
        graph.minimize(
            reprojection, poses[self.camera], intrinsics[self.camera], points[self.point], self.pixels, sigma=sigma,
            robust=robust, name="observations",
        )  # fmt: skip
        angle = np.mean(sigma) / (float(np.median(np.abs(self.intrinsics[:, 0]))) or 1.0)
        graph.minimize(
            _apart, poses[other], centres[0], far[other], sigma=HELD * angle * far[other], name="scale of the map"
        )
        if calibrated:
            graph.fix(intrinsics, self.intrinsics, name="calibration")
        seen = np.flatnonzero(np.bincount(self.point, minlength=len(self.points)) < 2)
        if len(seen):
            size = float(np.ptp(self.points, axis=0).max()) or 1.0
            graph.minimize(prior, points[seen], self.points[seen], sigma=size, name="points seen once")
        return graph, {poses: self.poses, intrinsics: self.intrinsics, points: self.points}


def project(pose: Array, intrinsics: Array, point: Array) -> Array:
    """(n, 2) pixels of points (n, 3) in cameras (n, 7) with intrinsics (n, 3)."""
    local = SE3.act(pose, point)
    flat = -local[:, :2] / local[:, 2:]
    squared = np.sum(flat**2, axis=1, keepdims=True)
    scale = intrinsics[:, :1] * (1.0 + squared * (intrinsics[:, 1:2] + intrinsics[:, 2:3] * squared))
    return np.asarray(scale * flat)


def reprojection(pose: Array, intrinsics: Array, point: Array, pixel: Array) -> Array:
    """(n, 2) pixels by which points (n, 3) appear beside where they were observed (n, 2)."""
    return project(pose, intrinsics, point) - pixel


def triangulate(problem: BundleAdjustment) -> Array:
    """(P, 3) points from the poses and intrinsics alone: the least squares of the rays' linear equations.

    A point that is observed once, or along one ray only, keeps its value.
    """
    focal, first, second = problem.intrinsics[problem.camera].T[:, :, None]
    target = problem.pixels / focal
    radius = size = np.linalg.norm(target, axis=1, keepdims=True)
    for _ in range(UNDISTORTED):
        squared = radius**2
        off = radius * (1.0 + squared * (first + second * squared)) - size
        radius = radius - off / (1.0 + squared * (3.0 * first + 5.0 * second * squared))
    flat = target / (1.0 + radius**2 * (first + second * radius**2))
    matrices = SE3.to_matrix(problem.poses)[problem.camera]
    rows = matrices[:, :2, :3] + flat[:, :, None] * matrices[:, 2:3, :3]  # P_xy + flat P_z = 0
    right = -(matrices[:, :2, 3] + flat * matrices[:, 2:3, 3])
    count = len(problem.points)
    normal, moment = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, problem.point, np.einsum("nra,nrb->nab", rows, rows))
    np.add.at(moment, problem.point, np.einsum("nra,nr->na", rows, right))
    sound = np.linalg.cond(normal + 1e-300) < 1e12
    found = np.array(problem.points, dtype=np.float64)
    found[sound] = np.linalg.solve(normal[sound], moment[sound][:, :, None])[:, :, 0]
    return found


def _apart(pose: Array, centre: Array, distance: Array) -> Array:
    """(n, 1) by how much a camera is farther from a place (3,) than stated."""
    return np.asarray(np.linalg.norm(SE3.inverse(pose)[:, :3] - centre, axis=1, keepdims=True) - distance)
