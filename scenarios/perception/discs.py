"""Discs in one lidar scan that the map does not explain.

A beam that ends farther from every mapped surface than noise and a slightly wrong pose can account for has
met something new. Neighbouring beams of that kind form a cluster, and each cluster is taken for the visible
arc of a disc: a few Gauss-Newton steps fit centre and radius to the points, to the angle the cluster fills
where both its edges are in plain view, and to a prior on the radius, without which a short arc says little
about its curvature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.models.distance_map import DistanceMap
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.perception.rows import Rows
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["DiscFinder", "Discs"]

_GAUSS_NEWTON_STEPS = 4
_BEHIND = 0.15  # [m]; a neighbouring beam this much longer shows that the cluster ends there


@dataclass(frozen=True)
class Discs(Rows):
    """Discs seen in one scan.

    Attributes:
        centre: (k, 2) world frame [m].
        radius: (k,) [m].
        radius_sigma: (k,) standard deviation of the radius [m].
        distance: (k,) from the lidar to the centre [m].
    """

    centre: Array
    radius: Array
    radius_sigma: Array
    distance: Array

    @staticmethod
    def none() -> Discs:
        """Nothing has been seen."""
        return Discs(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class _Clusters:
    """Contiguous runs of unexplained points, body frame."""

    points: Array  # (n, 2)
    starts: IntArray  # (k,) first point of each run
    label: IntArray  # (n,) run of each point
    middle: Array  # (k,) bearing of the middle of the angle filled [rad]
    half: Array  # (k,) half the angle filled [rad]
    whole: BoolArray  # (k,) True where both edges are in plain view


@dataclass(frozen=True)
class DiscFinder:
    """Finds discs that the map does not show.

    Attributes:
        distance_map: distance to the mapped surfaces.
        threshold: an end point nearer to the map than this is explained by it [m].
        growth: added to the threshold per metre of range, for the heading error of the estimate [rad].
        range_max: farther returns are left alone [m].
        sigma: standard deviation of a range [m].
        radius_prior: mean and standard deviation of a radius [m].
        radius_bounds: smallest and greatest radius [m].
    """

    distance_map: DistanceMap
    threshold: float = 0.13
    growth: float = 0.015
    range_max: float = 7.0
    sigma: float = 0.02
    radius_prior: tuple[float, float] = (0.2, 0.04)
    radius_bounds: tuple[float, float] = (0.12, 0.30)

    def find(self, scan: Scan, pose: ArrayLike) -> Discs:
        """Discs in one scan taken at the estimated pose.

        Args:
            scan: one turn of the lidar.
            pose: (3,) estimated world_T_body [m, m, rad].

        Returns:
            The discs, in no particular order.
        """
        x, y, theta = np.asarray(pose, dtype=np.float64)
        near = scan.ranges < self.range_max  # False for dropouts and for beams without return
        ranges = np.where(near, scan.ranges, 0.0)
        points = np.stack([ranges * np.cos(scan.angles), ranges * np.sin(scan.angles)], axis=1)
        rotation = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        unexplained = near.copy()
        world = points[near] @ rotation.T + (x, y)
        unexplained[near] = self.distance_map.distance(world) > self.threshold + self.growth * ranges[near]
        clusters = self._cluster(scan, points, unexplained) if unexplained.any() else None
        if clusters is None:
            return Discs.none()
        centre, radius, radius_sigma = self._fit(clusters, scan.spacing)
        return Discs(centre @ rotation.T + (x, y), radius, radius_sigma, np.linalg.norm(centre, axis=1))

    def _cluster(self, scan: Scan, points: Array, unexplained: BoolArray) -> _Clusters | None:
        """Join unexplained beams that are neighbours in angle and in space; drop those that stay alone.

        Returns None when nothing is left.
        """
        beams, spacing = len(points), scan.spacing
        first = int(np.argmin(unexplained)) if scan.closed else 0  # an explained beam: no cluster crosses it
        order = (np.flatnonzero(np.roll(unexplained, -first)) + first) % beams
        chosen = points[order]
        ranges = scan.ranges[order]
        step = np.diff(order) % beams
        jump = np.linalg.norm(np.diff(chosen, axis=0), axis=1)
        parted = (step > 2) | (jump > 0.15 + 2.0 * spacing * ranges[1:])
        starts = np.concatenate([[0], np.flatnonzero(parted) + 1])
        label = np.concatenate([[0], np.cumsum(parted)])
        # Anything wider than the greatest disc becomes several: it is not a disc, but it must be kept clear
        # of.
        piece = np.linalg.norm(chosen - chosen[starts][label], axis=1) // (2.0 * self.radius_bounds[1] + 0.06)
        parted |= np.diff(piece) != 0.0
        label = np.concatenate([[0], np.cumsum(parted)])
        keep = np.bincount(label)[label] >= 2
        if not keep.any():
            return None
        order, chosen, ranges, label = order[keep], chosen[keep], ranges[keep], label[keep]
        starts = np.flatnonzero(np.diff(label, prepend=-1))
        ends = np.append(starts[1:], len(label)) - 1
        label = np.cumsum(np.diff(label, prepend=label[:1]) != 0)
        # NaN compares False: next to a lost beam an edge is not in plain view.
        around = scan.ranges if scan.closed else np.append(scan.ranges, np.nan)
        before = around[(order[starts] - 1) % len(around)] > ranges[starts] + _BEHIND
        after = around[(order[ends] + 1) % len(around)] > ranges[ends] + _BEHIND
        filled = ((order[ends] - order[starts]) % beams) * spacing
        return _Clusters(
            points=chosen,
            starts=starts,
            label=label,
            middle=scan.angles[order[starts]] + 0.5 * filled,
            half=0.5 * (filled + spacing),
            whole=before & after,
        )

    def _fit(self, clusters: _Clusters, spacing: float) -> tuple[Array, Array, Array]:
        """Centres (k, 2) in the body frame, radii (k,) and their standard deviations (k,) [m]."""
        points, starts, label = clusters.points, clusters.starts, clusters.label
        counts = np.diff(np.append(starts, len(label)))
        mean = np.add.reduceat(points, starts) / counts[:, None]
        reach = np.linalg.norm(mean, axis=1)
        prior, prior_sigma = self.radius_prior
        sine = np.sin(clusters.half)
        side = np.stack([-np.sin(clusters.middle), np.cos(clusters.middle)], axis=1)
        # The edges lie anywhere within a beam's spacing; without both of them the centre is only roughly
        # behind the points.
        side_weight = np.where(clusters.whole, 1.0 / (0.3 * spacing * reach + 0.005), 1.0 / 0.1)
        width_weight = np.where(clusters.whole, 1.0 / (0.3 * spacing * reach + 0.01), 0.0)
        first_guess = mean * (1.0 + 0.8 * prior / reach)[:, None]
        centre, radius = first_guess, np.full(len(starts), prior)

        # One row per measurement: derivative by x, y, radius and the residual. First the points, then one row
        # per cluster for the angle it fills, then one for the bearing of its middle; `member` sums the rows
        # that belong to a cluster.
        n, k = len(points), len(starts)
        rows = np.zeros((n + 2 * k, 4))
        on_arc, width, bearing = slice(0, n), slice(n, n + k), slice(n + k, n + 2 * k)
        rows[on_arc, 2] = -1.0 / self.sigma
        rows[width, 2] = -width_weight
        rows[bearing, :2] = side * side_weight[:, None]
        each = np.arange(k)
        member = (np.concatenate([label, each, each]) == each[:, None]).astype(np.float64)
        for _ in range(_GAUSS_NEWTON_STEPS):
            ray = points - centre[label]
            length = np.hypot(ray[:, 0], ray[:, 1])
            rows[on_arc, :2] = ray / (-self.sigma * length)[:, None]
            rows[on_arc, 3] = (length - radius[label]) / self.sigma
            distance = np.hypot(centre[:, 0], centre[:, 1])
            rows[width, :2] = centre * (width_weight * sine / distance)[:, None]
            rows[width, 3] = width_weight * (distance * sine - radius)
            rows[bearing, 3] = (rows[bearing, :2] * centre).sum(axis=1)
            system = (member @ (rows[:, :, None] * rows[:, None, :]).reshape(-1, 16)).reshape(k, 4, 4)
            system[:, 2, 2] += prior_sigma**-2
            system[:, 2, 3] += (radius - prior) * prior_sigma**-2
            step = np.linalg.solve(system[:, :3, :3], -system[:, :3, 3:])[:, :, 0]
            step *= np.minimum(1.0, 0.1 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
            centre = centre + step[:, :2]
            radius = (radius + step[:, 2]).clip(*self.radius_bounds)
        inward = np.linalg.norm(centre, axis=1) < reach  # hollow to the lidar: no disc's visible arc is
        centre = np.where(inward[:, None], first_guess, centre)
        radius_sigma = np.sqrt(np.linalg.inv(system[:, :3, :3])[:, 2, 2])
        return centre, np.where(inward, prior, radius), radius_sigma
