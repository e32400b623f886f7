"""The control cases for solvers of casadi, in the order x_0, u_0, x_1, ... from which fatrop sees the stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks import closed_loop
from benchmarks.control_problems import EFFORT, STAGE, TERMINAL, Problem, Quadrotor, Unicycle
from unifg.models.quadrotor import GRAVITY
from unifg.typing import Array


def peer(problem: Problem, plugin: str, compiled: bool = False, **options: Any) -> UnicyclePeer | QuadrotorPeer:
    """The expressions of a problem, built and differentiated; in casadi's virtual machine unless ``compiled``."""
    kind = UnicyclePeer if isinstance(problem, Unicycle) else QuadrotorPeer
    built: UnicyclePeer | QuadrotorPeer = kind(problem, plugin, **options)  # type: ignore[arg-type]
    if compiled:
        built.compile()
    return built


def warm(
    problem: Problem, plugin: str, compiled: bool = False, **options: Any
) -> tuple[closed_loop.Driver, Callable[[], float]]:
    """The same, driven in a loop with its own shifted answers; and what repeats its last solve."""
    built = peer(problem, plugin, compiled, **options)
    driver = Warm(built) if isinstance(built, QuadrotorPeer) else closed_loop.Warm(built)
    return driver, built.again


class UnicyclePeer(closed_loop.Peer):
    """The unicycle, timed by the processor time of this thread: a shared machine makes clocks run late."""

    def solve(self, states: Array, controls: Array, pose: Array | None = None, first: int = 0, **duals: Any) -> float:
        """Solve from a guess; returns the processor time of the call [ms]."""
        reference, _ = self.problem.reference(first)
        start = self.problem.start if pose is None else pose
        unknowns = np.append(np.hstack([states[:-1], controls]).ravel(), states[-1])
        parameters = np.append(start, reference.ravel())
        self._call = {"x0": unknowns, "p": parameters, **self._limits, **duals}
        begin = time.thread_time()
        self.answer = self._solver(**self._call)
        return 1e3 * (time.thread_time() - begin)

    def again(self) -> float:
        """Processor time of the same solve, when everything it needs is in the caches [ms]."""
        begin = time.thread_time()
        self._solver(**self._call)
        return 1e3 * (time.thread_time() - begin)


class QuadrotorPeer:
    """The quadrotor with unit quaternions, which keep their norm: rates are integrated exactly.

    Attributes:
        problem: what it solves.
        answer: of the last solve, with multipliers.
        gaps, spheres: rows of g, by stages.
    """

    def __init__(self, problem: Quadrotor, plugin: str, **options: Any) -> None:
        """Build and differentiate the expressions; start and references are parameters."""
        import casadi as ca

        n, dt = problem.horizon, problem.dt
        x, u = [ca.SX.sym("x", 10) for _ in range(n + 1)], [ca.SX.sym("u", 4) for _ in range(n)]
        start, reference, cruise = ca.SX.sym("start", 10), ca.SX.sym("r", 10, n + 1), ca.SX.sym("c", 4, n)

        def product(a: Any, b: Any) -> Any:
            scalar = a[0] * b[0] - ca.dot(a[1:], b[1:])
            return ca.vertcat(scalar, a[0] * b[1:] + b[0] * a[1:] + ca.cross(a[1:], b[1:]))

        def exponential(turn: Any) -> Any:
            # Series in the squared angle: square roots have no derivative at zero. |turn| is below 0.5.
            s = ca.dot(turn, turn) / 4
            cosine = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56)))
            sinc = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
            return ca.vertcat(cosine, 0.5 * sinc * turn)

        def up(q: Any) -> Any:
            w, a, b, c = q[0], q[1], q[2], q[3]
            return ca.vertcat(2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b))

        def error(state: Any, wanted: Any) -> Any:
            q = product(ca.vertcat(wanted[3], -wanted[4:7]), state[3:7])
            length = ca.sqrt(ca.dot(q[1:], q[1:]) + 1e-8)
            return ca.vertcat(
                state[:3] - wanted[:3], 2 * ca.atan2(length, q[0]) / length * q[1:], state[7:] - wanted[7:]
            )

        def advance(state: Any, control: Any) -> Any:
            q = product(state[3:7], exponential(dt * control[:3]))
            pull = 0.5 * control[3] * (up(state[3:7]) + up(q)) - ca.DM([0, 0, GRAVITY])
            v = state[7:] + dt * pull
            return ca.vertcat(state[:3] + 0.5 * dt * (state[7:] + v), q, v)

        X, U = ca.SX.sym("X", 10), ca.SX.sym("U", 4)
        W = ca.SX.sym("W", 10)
        move, deviation = ca.Function("f", [X, U], [advance(X, U)]), ca.Function("e", [X, W], [error(X, W)])
        cost: Any = 0.0
        rows: list[Any] = []
        equality: list[bool] = []
        gaps, spheres = [], []
        for k in range(n + 1):
            off = deviation(x[k], reference[:, k])
            cost += 0.5 * ca.dot(ca.DM(STAGE if k < n else TERMINAL) * off, off)
            if k < n:
                effort = u[k] - cruise[:, k]
                cost += 0.5 * ca.dot(ca.DM(EFFORT) * effort, effort)
                gaps.append(len(equality))
                rows.append(x[k + 1] - move(x[k], u[k]))
                equality += [True] * 10
            if k == 0:
                rows.append(x[0] - start)
                equality += [True] * 10
            elif problem.blocked:
                spheres.append(len(equality))
                axes = 2 if problem.upright else 3
                rows += [ca.sumsqr(x[k][:axes] - s[:axes]) - s[3] ** 2 for s in problem.discs]
                equality += [False] * len(problem.discs)
        unknowns = ca.vertcat(*(part for pair in zip(x[:-1], u, strict=True) for part in pair), x[-1])
        given = ca.vertcat(start, ca.vec(reference), ca.vec(cruise))
        program = {"x": unknowns, "p": given, "f": cost, "g": ca.vertcat(*rows)}
        chosen: dict[str, Any] = {"print_time": False, plugin: {"print_level": 0, "tol": 1e-6, **options}}
        if plugin == "fatrop":
            chosen |= {"structure_detection": "auto", "equality": equality}
        else:
            chosen[plugin]["sb"] = "yes"
        self.problem = problem
        self.gaps, self.spheres = np.array(gaps), np.array(spheres, dtype=int)
        self._solver: Any = ca.nlpsol("solver", plugin, program, chosen)
        self._made = plugin, chosen
        free = np.full(10, np.inf)
        lower = np.append(np.tile(np.append(-free, problem.lower), n), -free)
        upper = np.append(np.tile(np.append(free, problem.upper), n), free)
        self._limits = {"lbx": lower, "ubx": upper, "lbg": 0.0, "ubg": np.where(equality, 0.0, np.inf)}
        self.answer: dict[str, Any] = {}

    def compile(self) -> None:
        """Evaluate its functions in machine code from now on."""
        from benchmarks.compiled_peers import compiled

        self._solver = compiled(self._solver, *self._made)

    def solve(self, states: Array, controls: Array, pose: Array | None = None, first: int = 0, **duals: Any) -> float:
        """Solve from a guess; returns the processor time of the call [ms]."""
        reference, cruise = self.problem.reference(first)
        start = self.problem.start if pose is None else pose
        unknowns = np.append(np.hstack([states[:-1], controls]).ravel(), states[-1])
        parameters = np.concatenate([start, reference.ravel(), cruise.ravel()])
        self._call = {"x0": unknowns, "p": parameters, **self._limits, **duals}
        begin = time.thread_time()
        self.answer = self._solver(**self._call)
        return 1e3 * (time.thread_time() - begin)

    def again(self) -> float:
        """Processor time of the same solve, when everything it needs is in the caches [ms]."""
        begin = time.thread_time()
        self._solver(**self._call)
        return 1e3 * (time.thread_time() - begin)

    @property
    def status(self) -> str:
        """In words."""
        statistics = self._solver.stats()
        return "converged" if statistics["success"] else str(statistics.get("return_status", "failed"))

    @property
    def iterations(self) -> int:
        """Of the last solve."""
        return int(self._solver.stats()["iter_count"])

    @property
    def cost(self) -> float:
        """Of the last answer."""
        return float(self.answer["f"])

    @property
    def trajectory(self) -> tuple[Array, Array]:
        """States (N + 1, 10) and controls (N, 4) of the last answer."""
        unknowns = np.append(np.asarray(self.answer["x"]).ravel(), np.zeros(4)).reshape(-1, 14)
        return unknowns[:, :10], unknowns[:-1, 10:]


class Warm:
    """A peer driven with its own answers, values and multipliers moved by one stage."""

    def __init__(self, peer: QuadrotorPeer) -> None:
        """Take a peer whose options suit a warm start."""
        self._peer = peer

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, str]:
        """Cold the first time, then shifted."""
        peer = self._peer
        if not peer.answer:
            elapsed = peer.solve(*peer.problem.guess(), pose, index)
        else:
            states, controls = (np.vstack([part[1:], part[-1:]]) for part in peer.trajectory)
            states[0] = pose
            elapsed = peer.solve(states, controls, pose, index, lam_g0=self._rows(), lam_x0=self._bounds())
        return peer.trajectory[1][0], elapsed, peer.iterations, peer.status

    def _rows(self) -> Array:
        old = np.asarray(self._peer.answer["lam_g"]).ravel()
        new = old.copy()
        for first, size in ((self._peer.gaps, 10), (self._peer.spheres, len(self._peer.problem.discs))):
            if len(first):
                rows = first[:, None] + np.arange(size)
                new[rows[:-1]] = old[rows[1:]]
        return new

    def _bounds(self) -> Array:
        new = np.asarray(self._peer.answer["lam_x"]).ravel().copy()
        new[: -10 - 14] = new[14:-10].copy()
        return new
