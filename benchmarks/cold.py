"""Cold solves of control problems: from the listed guess, every solver in turn, beside IPOPT and fatrop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

import numpy as np

import unifg as fg
from benchmarks import compiled_peers
from benchmarks.casadi_peer import available
from benchmarks.report import listing, words
from benchmarks.timing import clocked, interleave, number
from problems.control import Problem, Stated

PEERS = ("ipopt", "fatrop", "fatrop, compiled")
"""The last one with its functions in machine code, the others in the virtual machine of casadi."""


def runnable(peers: tuple[str, ...] = PEERS) -> tuple[str, ...]:
    """Those this machine can run."""
    return tuple(name for name in peers if available() and (compiled_peers.COMPILER or "compiled" not in name))


@dataclass(frozen=True)
class Rules:
    """Rules of measuring and judging of a page.

    Attributes:
        tolerance: of every solver.
        same: relative difference below which two costs are one optimum.
        slow: a solve that takes longer is not repeated [ms].
        peers: beside ours, of :data:`PEERS`.
    """

    tolerance: float
    same: float
    slow: float
    peers: tuple[str, ...]


@dataclass
class Outcome:
    """Result of one solver on one problem.

    Attributes:
        problem, solver: which.
        status: in words.
        iterations: of the solver.
        cost: with its 1/2.
        times: one per round [ms].
    """

    problem: Problem
    solver: str
    status: str = ""
    iterations: int = 0
    cost: float = np.nan
    times: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))

    def verdict(self, rules: Rules) -> str:
        """Comparison of the cost with the known optima."""
        if self.status != "converged":
            return self.status
        relative = [self.cost / known - 1.0 for known in self.problem.optima]
        if abs(relative[0]) < rules.same:
            return "listed"
        if min(map(abs, relative)) < rules.same:
            return "listed alternative"
        return f"{'lower' if relative[0] < 0.0 else 'other'}, {100.0 * relative[0]:+.2g} %"


Outcomes: TypeAlias = dict[str, Outcome]
Results: TypeAlias = Mapping[Problem, Outcomes]
Told: TypeAlias = Callable[[Outcome], str]


def attempt(solver: fg.Solver, stated: Stated) -> Callable[[Outcome], float]:
    """A cold solve by one of ours, the graph compiled before; its processor time [ms]."""
    run = solver.prepare(stated.graph)

    def solve(outcome: Outcome) -> float:
        solution, seconds = clocked(run.solve, stated.guess)
        outcome.status = words(solution.status)
        outcome.iterations, outcome.cost = solution.iterations, solution.cost
        return 1e3 * seconds

    return solve


def attempt_peer(name: str, problem: Problem, tolerance: float) -> Callable[[Outcome], float]:
    """A cold solve through casadi: expressions built, differentiated and, if so named, compiled before."""
    from benchmarks.control_peers import ControlPeer

    plugin, _, compiled = name.partition(", ")
    peer = ControlPeer(problem, plugin, bool(compiled), tol=tolerance)
    guess = problem.guess()

    def solve(outcome: Outcome) -> float:
        elapsed = peer.solve(*guess)
        outcome.status, outcome.iterations, outcome.cost = peer.status, peer.iterations, peer.cost
        return elapsed

    return solve


def measure(problem: Problem, solvers: Mapping[str, fg.Solver], rules: Rules, rounds: int) -> Outcomes:
    """Solve a problem with every solver, ``rounds`` times after one that is not counted."""
    attempts = {name: attempt(solver, problem.formulation()) for name, solver in solvers.items()}
    attempts |= {name: attempt_peer(name, problem, rules.tolerance) for name in runnable(rules.peers)}
    outcomes = {name: Outcome(problem, name) for name in attempts}
    times = interleave(
        {name: partial(solve, outcomes[name]) for name, solve in attempts.items()}, rounds, slow=rules.slow
    )
    for name, outcome in outcomes.items():
        outcome.times = times[name].tolist()
    return outcomes


def ratio(results: Results, outcome: Outcome, peer: str) -> float:
    """Time over that of a peer, where both converged; plain peers are not compared with others."""
    other = results[outcome.problem].get(peer)
    if other is None or outcome.solver in (peer, *PEERS[:-1]):
        return np.nan
    return outcome.median / other.median if outcome.status == other.status == "converged" else np.nan


def summary(results: Results, rules: Rules, counted: Mapping[str, Callable[[Outcome], bool]]) -> str:
    """One row per solver: how often it did what is counted, its iterations and times."""

    def mean(peer: str) -> Callable[[list[Outcome]], str]:
        def told(mine: list[Outcome]) -> str:
            logs = np.log([ratio(results, outcome, peer) for outcome in mine])
            return "-" if np.isnan(logs).all() else f"{np.exp(np.nanmean(logs)):.2f}"

        return told

    def share(right: Callable[[Outcome], bool]) -> Callable[[list[Outcome]], str]:
        return lambda mine: f"{sum(map(right, mine))} / {len(mine)}"

    columns: dict[str, Callable[[list[Outcome]], str]] = {
        **{title: share(right) for title, right in counted.items()},
        "iterations in all": lambda mine: str(sum(outcome.iterations for outcome in mine)),
        "median [ms]": lambda mine: number(float(np.median([outcome.median for outcome in mine]))),
        "slowest [ms]": lambda mine: number(max(outcome.median for outcome in mine)),
        **{f"times {peer} (geometric mean)": mean(peer) for peer in runnable(rules.peers)},
    }
    names = dict.fromkeys(name for outcomes in results.values() for name in outcomes)
    groups = {(name,): [outcomes[name] for outcomes in results.values()] for name in names}
    return listing(["solver"], groups, columns)


def every(results: Results, rules: Rules) -> str:
    """One row per problem and solver."""

    def times(peer: str) -> Told:
        return lambda outcome: f"{ratio(results, outcome, peer):.2f}".replace("nan", "-")

    columns: dict[str, Told] = {
        "optimum": lambda outcome: outcome.verdict(rules),
        "cost": lambda outcome: f"{outcome.cost:.5f}",
        "listed": lambda outcome: f"{outcome.problem.optima[0]:.5f}",
        "iterations": lambda outcome: str(outcome.iterations),
        "ms": lambda outcome: number(outcome.median),
        **{f"times {peer}": times(peer) for peer in runnable(rules.peers)},
    }
    every_one = [outcome for outcomes in results.values() for outcome in outcomes.values()]
    return listing(["case", "solver"], {(one.problem.title, one.solver): one for one in every_one}, columns)
