"""A hundred closed-loop steps of the unicycle by every solver, each warm-started with its own shifted answer.

Driven by :mod:`benchmarks.reference_problems`, whose tables it extends.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from benchmarks.report import table
from unifg.typing import Array

if TYPE_CHECKING:  # it imports this module
    import unifg as fg
    from benchmarks.reference_problems import Formulation, Peer, Problem

STEPS = 100
WARM_IPOPT: dict[str, Any] = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-6,
    "warm_start_bound_frac": 1e-6,
    "warm_start_slack_bound_push": 1e-6,
    "warm_start_slack_bound_frac": 1e-6,
    "warm_start_mult_bound_push": 1e-6,
}


class Driver(Protocol):
    """A solver that keeps its last answer for the next step."""

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, bool]:
        """First control (2,), time of the solve [ms], iterations, and whether it converged."""
        ...


class Ours:
    """A backend of ours: structure and workspaces kept, start and references given as data."""

    def __init__(self, solver: fg.Solver, formulation: Formulation) -> None:
        """Prepare the graph."""
        self._formulation = formulation
        self._run = solver.prepare(formulation.graph)
        self._last: fg.Solution | None = None

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, bool]:
        """Cold the first time, then from the shifted primal-dual answer."""
        x, u = self._formulation.x, self._formulation.u
        start = self._formulation.guess if self._last is None else self._last.shifted(x, u, by=1)
        data = self._formulation.data(pose, index)
        begin = time.perf_counter()
        solution = self._run.solve(start, data=data)
        elapsed = 1e3 * (time.perf_counter() - begin)
        self._last = solution
        return solution[u][0], elapsed, solution.iterations, solution.converged


class Warm:
    """A solver of casadi with the same shift."""

    def __init__(self, peer: Peer) -> None:
        """Take a peer whose options suit a warm start."""
        self._peer = peer
        discs = len(peer.problem.discs)
        # Rows of g as the peer lists them: 3 gaps and 3 of the start, then 3 gaps and the discs, at last the discs.
        stages = np.arange(peer.problem.horizon - 1)
        self._gaps = np.concatenate([[0], 6 + (3 + discs) * stages])
        self._discs = np.append(6 + (3 + discs) * stages + 3, 6 + (3 + discs) * len(stages))

    def control(self, pose: Array, index: int) -> tuple[Array, float, int, bool]:
        """Cold the first time, then shifted."""
        peer = self._peer
        if not peer.answer:
            elapsed = peer.solve(*peer.problem.guess(), pose, index)
        else:
            states, controls = (np.vstack([part[1:], part[-1:]]) for part in peer.trajectory)
            states[0] = pose
            elapsed = peer.solve(states, controls, pose, index, lam_g0=self._rows(), lam_x0=self._bounds())
        return peer.trajectory[1][0], elapsed, peer.iterations, peer.status == "converged"

    def _rows(self) -> Array:
        old = np.asarray(self._peer.answer["lam_g"]).ravel()
        new = old.copy()
        for first, size in ((self._gaps, 3), (self._discs, len(self._peer.problem.discs))):
            rows = first[:, None] + np.arange(size)
            new[rows[:-1]] = old[rows[1:]]
        return new

    def _bounds(self) -> Array:
        new = np.asarray(self._peer.answer["lam_x"]).ravel().copy()
        new[: -3 - 5] = new[5:-3].copy()
        return new


@dataclass
class Loop:
    """What one solver made of one drive.

    Attributes:
        times: of the solves after the first [ms].
        iterations: of the same.
        failures: solves that did not converge, the first included.
        cost: sum of the stage costs.
        penetration: deepest point of the poses in a disc [m].
    """

    times: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    failures: int = 0
    cost: float = 0.0
    penetration: float = 0.0


def drive(problem: Problem, start: Array, drivers: Mapping[str, Driver]) -> dict[str, Loop]:
    """Drive every robot one step in turn: a slow moment of the machine meets all of them."""
    loops = {name: Loop() for name in drivers}
    poses = dict.fromkeys(drivers, start)
    controls: dict[str, Array] = {}
    for index in range(STEPS + 1):
        for name, driver in drivers.items():
            loop = loops[name]
            if index:
                loop.cost += problem.stage_cost(poses[name], controls[name], index - 1)
                poses[name] = problem.plant(poses[name], controls[name], index - 1)
                for *centre, radius in problem.discs:
                    depth = radius - float(np.linalg.norm(poses[name][:2] - centre))
                    loop.penetration = max(loop.penetration, depth)
            controls[name], elapsed, iterations, converged = driver.control(poses[name], index)
            loop.failures += not converged
            if index:  # the cold solve is no step of the loop
                loop.times.append(elapsed)
                loop.iterations.append(iterations)
    return loops


def render(results: Mapping[Problem, Mapping[str, Loop]]) -> str:
    """A table and what it means."""
    head = (
        "closed loop", "solver", "median [ms]", "p99 [ms]", "iterations, median", "iterations, most", "failures",
        "cost", "penetration [mm]", "times ipopt", "times fatrop",
    )  # fmt: skip
    lines = []
    for problem, loops in results.items():
        for name, loop in loops.items():
            median = float(np.median(loop.times))
            ratios = [
                f"{median / float(np.median(loops[peer].times)):.1f}"
                if peer in loops and name not in ("ipopt", "fatrop")
                else "-"
                for peer in ("ipopt", "fatrop")
            ]
            lines.append(
                (
                    problem.name, name, f"{median:.1f}", f"{np.percentile(loop.times, 99):.1f}",
                    f"{np.median(loop.iterations):.0f}", str(max(loop.iterations)), str(loop.failures),
                    f"{loop.cost:.4f}", f"{1e3 * loop.penetration:.3f}", *ratios,
                )
            )  # fmt: skip
    notes = (
        f"{STEPS} steps, tolerance 1e-4, interleaved; the time is that of the solve call, after a cold solve that is "
        "not counted. Warm start: values and multipliers moved by one stage, the last ones repeated (fatrop takes no "
        "multipliers). Without discs the plant is disturbed by d(i) = 0.01 (sin 1.7 i, cos 2.3 i, sin 3.1 i). Cost: "
        "sum of the stage costs of the poses and controls that happened."
    )
    return "\n\n".join([table(head, lines, text=2), notes])
