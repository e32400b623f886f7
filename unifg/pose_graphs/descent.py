"""Descent of chordal costs from far away, over frames of any dimension: a trust region, whose steps truncate.

Each step minimises the second-order model along the manifold by conjugate gradients (Steihaug, SIAM J. Numer. Anal. 20,
1983; on manifolds, Absil, Baker, Gallivan, Found. Comput. Math. 7, 2007), preconditioned by the quadratic itself, which
is factorised once and is the same for all dimensions (D. Rosen, L. Carlone, A. Bandeira, J. Leonard, "SE-Sync", IJRR
38(2-3), 2019, section 4.3.1).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from unifg.codegen.jit import compiled
from unifg.pose_graphs.linear import BlockQuadratic, block_gradient, polar
from unifg.pose_graphs.relaxation import Relaxation, sheared
from unifg.typing import Array

__all__ = ["Descent"]

STEPS, INNER = 200, 200  # of a descent, and products for each
REGULAR = 1e-6  # of the largest weight, added to the quadratic, which sees no common turn
SHARE = 0.01  # of the squared slope that a step may leave
ROUNDS = 100
STILL = 1e-12  # of the cost, what a step must promise
FAR = 1e-3  # of the cost, what a step promises or half the squared slope: from there Newton's method is quicker
FRAME = 1e-9  # a bend of the quadratic below this share of its diagonal is damped
KEPT, POOR, GOOD = 0.05, 0.25, 0.75  # measured by predicted decrease: taken, shorter radius, longer radius


class Descent:
    """Descents of one relaxation: its quadratic is factorised once, when the first begins.

    Attributes:
        problem: the relaxation.
        factorization: of the quadratic over positions and frames, regularised.
        frames: (n (d + 1),) one for the numbers of frames, zero for those of positions.
    """

    def __init__(self, problem: Relaxation) -> None:
        """Find the structure of the quadratic."""
        self.problem, above = problem, problem.dim + 1
        self._system = BlockQuadratic(problem.first, problem.second, problem.count, above, np.zeros(0, dtype=np.intp))
        self._scale = float(np.max(problem.by_second**2, initial=0.0))
        self.frames = np.tile(np.arange(above) > 0, problem.count).astype(np.float64)
        self.factorization = self._system.factorization

    @cached_property
    def able(self) -> bool:
        """False where the quadratic cannot be factorised, regularised."""
        problem, shift = self.problem, REGULAR * self._scale
        entries, able = self.entries(np.zeros((problem.count, problem.dim, problem.dim))), shift > 0.0
        while able and not (self.factorization.factor(entries, shift * self.frames) and self.factorization.definite):
            shift *= 10.0
            able = bool(np.isfinite(shift))
        return able

    def entries(self, multipliers: Array) -> Array:
        """(nnz,) entries of the quadratic less multipliers (n, d, d) of the frames."""
        problem = self.problem
        own = np.pad(-multipliers, ((0, 0), (1, 0), (1, 0)))
        own[problem.anchors, 0, 0] = self._scale or 1.0  # shifting all of a part changes nothing: one place may be held
        return self._system.entries(problem.by_first, problem.by_second, own)

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
            slope = self.problem.product(point)
            multipliers = sheared(slope, point)
            slope[:, 1:] -= multipliers @ point[:, 1:]
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

    def minimize(self, point: Array) -> Array:
        """A local minimum of rank d near a point, by Newton's method on positions and frames; anchors stay.

        The second derivative along the manifold is the quadratic less the multipliers; where it is not positive, it is
        damped. Far from a minimum, where the first step promises much or there is none, a descent goes before.
        """
        problem, dim = self.problem, self.problem.dim
        spins = [(i, k) for i in range(dim) for k in range(i)]
        size = dim + len(spins)
        system = BlockQuadratic(problem.first, problem.second, problem.count, size, problem.anchors)
        if not len(system.free) or not len(problem.first):
            return point
        near, cost, damping, scale = False, problem.cost(point), 0.0, self._scale
        for _ in range(ROUNDS):
            basis = _tangents(point, spins)
            flat = basis.reshape(problem.count, dim + 1, dim * size)
            shape = (len(problem.first), (dim + 1) * dim, size)
            J_first = (problem.by_first @ flat[problem.first]).reshape(shape)
            J_second = (problem.by_second @ flat[problem.second]).reshape(shape)
            error = problem.errors(point).reshape(len(problem.first), -1, 1)
            slopes = block_gradient(problem.first, problem.second, J_first, J_second, error, problem.count)
            gradient = slopes[system.free]
            frames = basis[:, 1:]
            bend = np.einsum("narq,nab,nbrs->nqs", frames, problem.multipliers(point), frames)
            entries = system.entries(J_first, J_second, -bend)
            step = None
            while step is None:
                added = np.full(len(system.free) * size, damping)
                if system.factorization.factor(entries, added) and system.factorization.definite:
                    step = -system.solve(gradient)
                elif not near:
                    break
                elif not damping < 1e3 * scale:  # so, too, where no edge has a weight
                    return point
                else:
                    damping = max(10.0 * damping, FRAME * scale)
            promised = np.inf if step is None else -float(np.sum(gradient * step))
            if step is None or not (near or promised <= FAR * cost):
                point, near = problem.anchored(self(point, FAR), point), True
                cost = problem.cost(point)
                continue
            near = True
            whole = np.zeros((problem.count, size))
            whole[system.free] = step[:, :, 0]
            trial = _retract(point, basis, whole)
            lower = problem.cost(trial)
            if promised <= STILL * cost:
                # Here rounding decides which cost is lower. The multipliers are as exact as the slope, though, which a
                # last step by Newton's method squares, so that it is taken unless it is no such step any more.
                return trial if lower <= cost * (1.0 + 1e3 * STILL) else point
            if lower <= cost:
                point, cost, damping = trial, lower, (0.1 * damping if damping > FRAME * scale else 0.0)
            else:
                damping = max(10.0 * damping, FRAME * scale)
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
        """Half the second derivative along the manifold, times a direction."""
        out = self.problem.product(moved)
        out[:, 1:] -= multipliers @ moved[:, 1:]
        _project(point, out)
        return out

    def _preconditioned(self, point: Array, slope: Array) -> Array:
        """Solution of the quadratic for all dimensions, along the manifold."""
        solved = self.factorization.solve(slope.reshape(-1, slope.shape[2]))
        out = np.array(solved, order="C").reshape(slope.shape)
        _project(point, out)
        return out


def _tangents(point: Array, spins: list[tuple[int, int]]) -> Array:
    """(n, d + 1, d, q) directions of positions and frames: d shifts, turns of the frame."""
    count, above, dim = point.shape
    basis = np.zeros((count, above, dim, dim + len(spins)))
    for k in range(dim):
        basis[:, 0, k, k] = 1.0
    for at, (i, k) in enumerate(spins, dim):
        basis[:, 1 + i, :, at], basis[:, 1 + k, :, at] = point[:, 1 + k], -point[:, 1 + i]
    return basis


def _retract(point: Array, basis: Array, step: Array) -> Array:
    """The nearest frames to a point moved by steps (n, q)."""
    moved: Array = point + np.einsum("narq,nq->nar", basis, step)
    moved[:, 1:] = polar(moved[:, 1:])
    return moved


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
