"""Descent of chordal costs from far away, over frames of any dimension: a trust region, whose steps truncate.

Each step minimises the second-order model along the manifold by conjugate gradients (Steihaug, SIAM J. Numer. Anal. 20,
1983; on manifolds, Absil, Baker, Gallivan, Found. Comput. Math. 7, 2007), preconditioned by the quadratic itself, which
is factorised once and is the same for all dimensions (D. Rosen, L. Carlone, A. Bandeira, J. Leonard, "SE-Sync", IJRR
38(2-3), 2019, section 4.3.1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unifg.codegen.jit import compiled
from unifg.pose_graphs.linear import BlockQuadratic, polar
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    from unifg.pose_graphs.relaxation import Relaxation

__all__ = ["Descent"]

STEPS, INNER = 200, 200  # of a descent, and products for each
REGULAR = 1e-6  # of the largest weight, added to the quadratic, which sees no common turn
SHARE = 0.01  # of the squared slope that a step may leave
KEPT, POOR, GOOD = 0.05, 0.25, 0.75  # measured by predicted decrease: taken, shorter radius, longer radius


class Descent:
    """Descents of one relaxation: its quadratic is factorised once."""

    def __init__(self, problem: Relaxation) -> None:
        """Factorise the quadratic, regularised."""
        self.problem, above = problem, problem.dim + 1
        self._system = BlockQuadratic(problem.first, problem.second, problem.count, above, np.zeros(0, dtype=np.intp))
        own = np.zeros((problem.count, above, above))
        own[problem.anchors, 0, 0] = float(np.max(problem.by_second**2, initial=0.0))
        entries = self._system.entries(problem.by_first, problem.by_second, own)
        shift = REGULAR * float(np.max(np.abs(problem.by_second), initial=0.0)) ** 2
        frames = np.tile(np.arange(above) > 0, problem.count).astype(np.float64)
        factorization, self.able = self._system.factorization, shift > 0.0
        while self.able and not (factorization.factor(entries, shift * frames) and factorization.definite):
            shift *= 10.0
            self.able = np.isfinite(shift)

    def __call__(self, point: Array, share: float) -> Array:
        """Descend until half the squared slope, as the quadratic measures it, is at most a share of the cost.

        Args:
            point: (n, d + 1, r).
            share: of the cost.

        Returns:
            A point that costs no more; the same where the quadratic cannot be factorised.
        """
        if not self.able:
            return point
        cost, radius = self.problem.cost(point), 0.0
        for _ in range(STEPS):
            multipliers = self.problem.multipliers(point)
            slope = self._along(point, point, multipliers)
            toward = self._preconditioned(point, slope)
            squared = float(np.sum(slope * toward))
            if not squared > share * cost:
                break
            radius = radius or np.sqrt(squared)
            step, promised, at_edge = self._step(point, multipliers, slope, toward, radius)
            trial = point + step
            trial[:, 1:] = polar(trial[:, 1:])
            lower = self.problem.cost(trial)
            gain = (cost - lower) / promised if promised > 0.0 else -1.0
            radius *= 0.25 if gain < POOR else 2.0 if at_edge and gain > GOOD else 1.0
            if gain > KEPT:
                point, cost = trial, lower
            elif not radius > np.sqrt(np.finfo(float).eps * squared):
                break
        return point

    def _step(
        self, point: Array, multipliers: Array, slope: Array, toward: Array, radius: float
    ) -> tuple[Array, float, bool]:
        """Step along the manifold, the decrease it promises, and whether it ends at the radius."""
        step, curved, left = np.zeros_like(point), np.zeros_like(point), slope
        direction, squared = -toward, float(np.sum(slope * toward))
        first, length, across, along, at_edge = squared, 0.0, 0.0, squared, False
        for _ in range(INNER):
            bent = self._along(point, direction, multipliers)
            curvature = float(np.sum(direction * bent))
            share = squared / curvature if curvature > 0.0 else np.inf
            longer = length + 2.0 * share * across + share**2 * along if curvature > 0.0 else np.inf
            at_edge = not longer < radius**2
            if at_edge:
                share = (-across + np.sqrt(across**2 + along * (radius**2 - length))) / along
            step, curved = step + share * direction, curved + share * bent
            if at_edge:
                break
            left, length = left + share * bent, longer
            toward = self._preconditioned(point, left)
            rest = float(np.sum(left * toward))
            if rest <= SHARE * first:
                break
            ratio, across = rest / squared, rest / squared * (across + share * along)
            squared, along, direction = rest, rest + ratio**2 * along, ratio * direction - toward
        return step, -float(np.sum((2.0 * slope + curved) * step)), at_edge

    def _along(self, point: Array, moved: Array, multipliers: Array) -> Array:
        """Half the second derivative along the manifold, times a direction; of the point itself, half the slope."""
        problem, out = self.problem, np.zeros_like(point)
        _multiply(problem.first, problem.second, problem.by_first, problem.by_second, moved, out)
        out[:, 1:] -= multipliers @ moved[:, 1:]
        _project(point, out)
        return out

    def _preconditioned(self, point: Array, slope: Array) -> Array:
        """Solution of the quadratic for all dimensions, along the manifold."""
        solved = self._system.factorization.solve(slope.reshape(-1, slope.shape[2]))
        out = np.array(solved, order="C").reshape(slope.shape)
        _project(point, out)
        return out


@compiled
def _multiply(first: IntArray, second: IntArray, by_first: Array, by_second: Array, moved: Array, out: Array) -> None:
    """Add the quadratic's product with a direction to ``out``."""
    above, rank = moved.shape[1], moved.shape[2]
    error = np.empty(rank)
    for k in range(len(first)):
        i, j = first[k], second[k]
        for row in range(above):
            error[:] = 0.0
            for a in range(above):
                left, right = by_first[k, row, a], by_second[k, row, a]
                for c in range(rank):
                    error[c] += left * moved[i, a, c] + right * moved[j, a, c]
            for a in range(above):
                left, right = by_first[k, row, a], by_second[k, row, a]
                for c in range(rank):
                    out[i, a, c] += left * error[c]
                    out[j, a, c] += right * error[c]


@compiled
def _project(point: Array, moved: Array) -> None:
    """Take from directions of frames what stretches or shears them: sym(V Y') Y, in place."""
    dim, rank = moved.shape[1] - 1, moved.shape[2]
    shear = np.empty((dim, dim))
    for n in range(len(moved)):
        for a in range(dim):
            for b in range(dim):
                total = 0.0
                for c in range(rank):
                    total += moved[n, 1 + a, c] * point[n, 1 + b, c] + moved[n, 1 + b, c] * point[n, 1 + a, c]
                shear[a, b] = 0.5 * total
        for a in range(dim):
            for b in range(dim):
                for c in range(rank):
                    moved[n, 1 + a, c] -= shear[a, b] * point[n, 1 + b, c]
