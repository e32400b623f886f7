"""Cold solves of control problems: from the listed guess, every solver in turn, beside IPOPT and fatrop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

import unifg as fg
from benchmarks import compiled_peers
from benchmarks.casadi_peer import available
from benchmarks.report import Columns, listing, words
from benchmarks.timing import clocked, interleave, number
from problems.control import Problem
from unifg.typing import Array

PEERS = ("ipopt", "fatrop", "fatrop, compiled")
"""The last one with its functions in machine code, the others in the virtual machine of casadi."""


def runnable(peers: tuple[str, ...] = PEERS) -> tuple[str, ...]:
    """Those this machine can run."""
    return tuple(name for name in peers if available() and (compiled_peers.COMPILER or "compiled" not in name))


TOLERANCE = 1e-4  # of every solver
SAME = 1e-4  # relative difference below which two costs are one optimum
SLOW = 0.3  # a solve that takes longer is not repeated [s]


class Contestant(Protocol):
    """A solver of one problem, ready to solve cold: ours, or a peer. A call returns the time that counts [s].

    Attributes:
        status: of the last solve, in words; empty where the solver does not tell.
        iterations: of the last solve; 0 where the solver does not tell.
        cost: of the last answer.
    """

    status: str
    iterations: int
    cost: float

    def __call__(self) -> float: ...  # noqa: D102


class Ours:
    """A backend of ours as a contestant, the graph compiled before.

    Attributes:
        solution: of the last solve.
        answer: values of the families of the guess.
    """

    def __init__(self, solver: fg.Solver, graph: fg.Graph, guess: fg.Guess) -> None:
        """Prepare."""
        self._run, self._guess = solver.prepare(graph), guess

    def __call__(self) -> float:
        """Solve; processor time [s]."""
        self.solution, spent = clocked(self._run.solve, self._guess)
        found = self.solution
        self.status, self.iterations, self.cost = words(found.status), found.iterations, found.cost
        self.answer = [np.array(found[family]) for family in self._guess.values]
        return spent


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
    status: str
    iterations: int
    cost: float
    times: Array

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))

    @property
    def verdict(self) -> str:
        """Comparison of the cost with the known optima."""
        if self.status != "converged":
            return self.status
        relative = [self.cost / known - 1.0 for known in self.problem.optima]
        if abs(relative[0]) < SAME:
            return "listed"
        if min(map(abs, relative)) < SAME:
            return "listed alternative"
        return f"{'lower' if relative[0] < 0.0 else 'other'}, {100.0 * relative[0]:+.2g} %"


Outcomes: TypeAlias = dict[str, Outcome]
Results: TypeAlias = Mapping[Problem, Outcomes]
Told: TypeAlias = Callable[[Outcome], str]


def peer(problem: Problem, name: str) -> Contestant:
    """A peer of :data:`PEERS`: expressions built, differentiated and, if so named, compiled before."""
    from benchmarks.control_peers import ControlPeer

    plugin, _, compiled = name.partition(", ")
    made = ControlPeer(problem, plugin, bool(compiled), tol=TOLERANCE)
    made.take(*problem.guess())
    return made


def outcomes(problem: Problem, contestants: Mapping[str, Contestant], rounds: int, slow: float = SLOW) -> Outcomes:
    """Solve a problem with all contestants, ``rounds`` times after one that is not counted."""
    times = interleave(contestants, rounds, slow=slow)
    return {
        name: Outcome(problem, name, one.status, one.iterations, one.cost, 1e3 * times[name])
        for name, one in contestants.items()
    }


def measure(problem: Problem, solvers: Mapping[str, fg.Solver], rounds: int) -> Outcomes:
    """Solve a problem with every solver, and with the peers that are here."""
    stated = problem.formulation()
    contestants: dict[str, Contestant] = {name: Ours(one, stated.graph, stated.guess) for name, one in solvers.items()}
    return outcomes(problem, contestants | {name: peer(problem, name) for name in runnable()}, rounds)


def ratio(results: Results, outcome: Outcome, peer: str) -> float:
    """Time over that of a peer, where both converged; plain peers are not compared with others."""
    other = results[outcome.problem].get(peer)
    if other is None or outcome.solver in (peer, *PEERS[:-1]):
        return np.nan
    return outcome.median / other.median if outcome.status == other.status == "converged" else np.nan


def summary(results: Results, counted: Mapping[str, Callable[[Outcome], bool]]) -> str:
    """One row per solver: how often it did what is counted, its iterations and times."""

    def mean(peer: str) -> Callable[[list[Outcome]], str]:
        def told(mine: list[Outcome]) -> str:
            logs = np.log([ratio(results, outcome, peer) for outcome in mine])
            return "-" if np.isnan(logs).all() else f"{np.exp(np.nanmean(logs)):.2f}"

        return told

    def share(right: Callable[[Outcome], bool]) -> Callable[[list[Outcome]], str]:
        return lambda mine: f"{sum(map(right, mine))} / {len(mine)}"

    columns: Columns[list[Outcome]] = {
        **{title: share(right) for title, right in counted.items()},
        "iterations in all": lambda mine: str(sum(outcome.iterations for outcome in mine)),
        "median [ms]": lambda mine: number(float(np.median([outcome.median for outcome in mine]))),
        "slowest [ms]": lambda mine: number(max(outcome.median for outcome in mine)),
        **{f"times {peer} (geometric mean)": mean(peer) for peer in runnable()},
    }
    names = dict.fromkeys(name for outcomes in results.values() for name in outcomes)
    groups = {(name,): [outcomes[name] for outcomes in results.values()] for name in names}
    return listing(["solver"], groups, columns)


def every(results: Results) -> str:
    """One row per problem and solver."""

    def times(peer: str) -> Told:
        return lambda outcome: f"{ratio(results, outcome, peer):.2f}".replace("nan", "-")

    columns: dict[str, Told] = {
        "optimum": lambda outcome: outcome.verdict,
        "cost": lambda outcome: f"{outcome.cost:.5f}",
        "listed": lambda outcome: f"{outcome.problem.optima[0]:.5f}",
        "iterations": lambda outcome: str(outcome.iterations),
        "ms": lambda outcome: number(outcome.median),
        **{f"times {peer}": times(peer) for peer in runnable()},
    }
    every_one = [outcome for outcomes in results.values() for outcome in outcomes.values()]
    return listing(["case", "solver"], {(one.problem.title, one.solver): one for one in every_one}, columns)
