"""Peers in one run: acados, SNOPT, crocoddyl and jaxls, in turn with ours on the same problems.

They live in an environment of their own, which ``make peers`` builds; each part of the page is a process there.
Control problems are stated as plain NumPy functions on our side. Times are compared where one judge accepts both
answers.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import thread_time
from typing import Any, TypeAlias
from unittest import mock

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks import control_loops
from benchmarks.cold import TOLERANCE, Ours
from benchmarks.control_loops import CONTACT, Race
from benchmarks.control_peers import MODELS
from benchmarks.own_functions import stated
from benchmarks.pose_graphs import cases
from benchmarks.report import CHECKOUT, Columns, machine, table, words
from benchmarks.runner import Timing, Unavailable
from benchmarks.timing import clocked, interleave, number, pin, ratio, shown
from problems.cart_pole import CartPole
from problems.control import Driver, Problem, Quadrotor, Tick, Unicycle
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.interior_point import method
from unifg.solvers.names import backends
from unifg.typing import Array

HOME = CHECKOUT / ".venv-peers"
WORSE = 0.01  # relative cost above the best from which an answer is not compared
SLOW = 5.0  # a solve that takes longer is not repeated [s]
LOOPS: dict[str, fg.Solver] = {
    "InteriorPoint, safe": InteriorPoint(tolerance=TOLERANCE, step_tolerance=np.inf, violation_tolerance=CONTACT),
    "InteriorPoint": InteriorPoint(tolerance=TOLERANCE),
    'SQP(qp="graph"), one iteration': SQP(tolerance=TOLERANCE, qp="graph", max_iterations=1),
}
COLD: dict[str, fg.Solver] = {
    "InteriorPoint": InteriorPoint(tolerance=TOLERANCE),
    'SQP(qp="graph")': SQP(tolerance=TOLERANCE, qp="graph"),
    "SQP": SQP(tolerance=TOLERANCE),
}
Of: TypeAlias = Mapping[str, Callable[[Array], Any]]
"""Numbers that are made of times, by heading."""


class SwingUp(CartPole):
    """The pole hangs at first."""

    stage, terminal, effort = np.array([2.0, 2.0, 0.02, 0.02]), np.array([200.0, 200.0, 2.0, 2.0]), np.array([0.02])
    lower, upper = np.full(1, -15.0), np.full(1, 15.0)

    @property
    def start(self) -> Array:
        """Hanging, at rest."""
        return np.array([0.0, np.pi, 0.0, 0.0])

    def guess(self) -> tuple[Array, Array]:
        """A straight line."""
        return np.linspace(self.start, np.zeros(4), self.horizon + 1), np.zeros((self.horizon, 1))


def problems() -> list[Problem]:
    """Those of the page."""
    driven = [Unicycle("straight", False, 20), Unicycle("straight", False, 50), Unicycle("straight", True, 50)]
    return [*driven, SwingUp("swing-up", False, 40), Quadrotor("goto", False, 20), Quadrotor("goto", True, 20)]


def on(problem: Problem, solver: fg.Solver) -> Ours:
    """A backend on a control problem that is stated as NumPy functions."""
    own = stated(problem, "numpy")
    return Ours(solver, own.graph, own.guess)


class Whole(Driver):
    """A backend in closed loop; the time is that of the shift, binding the data, the judged solve and the control."""

    def control(self, state: Array, index: int) -> Tick:
        """One step; the first one of a loop begins cold."""
        x, u, data = self._stated.x, self._stated.u, self._stated.data(state, index)
        begin = thread_time()
        if index == 0 or self._last is None:
            self._last = self._cold.solve(self._stated.guess, data=data)
        else:
            self._last = self._warm.solve(self._last.shifted(x, u, by=1), data=data)
        control = self._last[u][0]
        return Tick(control, 1e3 * (thread_time() - begin), self._last.iterations, words(self._last.status))


def judge(problem: Problem, states: Array, controls: Array) -> tuple[float, float]:
    """Largest violation, in the unit of each row (distances, not squares), and cost; by casadi and nothing of ours."""
    import casadi as ca

    p, (wanted, cruise), (error, gap) = problem, problem.reference(), MODELS[problem.robot]
    x, y, u = (ca.SX.sym("z", len(part)) for part in (p.start, p.start, p.effort))
    both: Any = ca.Function("both", [x, u, y], [gap(x, u, y, p.dt)]), ca.Function("error", [x, y], [error(x, y)])
    gaps, off = np.array(both[0](states[:-1].T, controls.T, states[1:].T)), np.array(both[1](states.T, wanted.T)).T
    outside = [np.abs(gaps).max(), np.abs(states[0] - p.start).max(), np.max(p.lower - controls)]
    outside += [np.max(controls - p.upper), max(map(p.penetration, states[1:])), 0.0]
    weights = np.vstack([np.tile(p.stage, (p.horizon, 1)), p.terminal])
    cost = 0.5 * np.sum(weights * off**2) + 0.5 * np.sum(p.effort * (controls - cruise) ** 2)
    return float(np.max(outside)), float(cost)


@dataclass
class Result:
    """One contestant's answers to one problem.

    Attributes:
        times: (rounds,) of solves, or (rounds, steps) of ticks [s].
        status, iterations: of the last solve; of a loop, its failures and mean.
        violation, cost: as judged.
        inside: share of the time in functions, ours compiled and not counted for peers in Python; nan if not measured.
    """

    times: Array
    status: str
    iterations: float
    violation: float
    cost: float
    inside: float = np.nan

    def refused(self, best: float = np.inf) -> str:
        """Reason for which the answer is not compared, empty if there is none."""
        if self.status not in ("", "converged"):
            return self.status
        if not self.violation <= TOLERANCE:
            return f"violates by {self.violation:.2g}"
        worse = self.cost / best - 1.0
        return f"costs {100.0 * worse:.1f} % more" if worse > WORSE else ""


Results: TypeAlias = dict[str, Result]
Found: TypeAlias = Mapping[str, Results]
"""Results by problem."""


def best(results: Results) -> float:
    """Least cost of an answer that keeps the constraints."""
    return min((one.cost for one in results.values() if not one.refused()), default=np.inf)


def compared(results: Results, name: str, peer: str, of: Callable[[Array], Array]) -> str:
    """Ratio of what is made of times, with its interval; where the judge refuses an answer, the reason."""
    for who in (name, peer):
        if refused := results[who].refused(best(results)):
            return f"{'ours' if who == name else 'peer'}: {refused}"
    return shown(ratio(of(results[name].times), of(results[peer].times)))


def race(problem: Problem, racers: Mapping[str, Race], rounds: int) -> Results:
    """Drive every robot one step in turn, in random order, ``rounds`` loops after one that is not counted."""
    rng = np.random.default_rng(0)
    loops = [
        control_loops.race(problem, racers, lambda names: rng.permutation(names).tolist()) for _ in range(rounds + 1)
    ]
    results = {}
    for name, last in loops[-1].items():
        times = 1e-3 * np.array([loop[name].times for loop in loops[1:]])
        failed = last.failures("iteration limit").items()
        status = ", ".join(f"{count} x {status}" for status, count in failed) or "converged"
        results[name] = Result(times, status, float(np.mean(last.iterations)), max(last.penetration, 0.0), last.cost)
    return results


def compiled_share(problem: Problem, racer: Race) -> float:
    """Share of the time of ticks that the interior point spends in compiled code, in a loop of its own."""
    inside, call = list[float](), vars(method)["call"]

    def timed(*given: Any) -> None:
        inside.append(clocked(call, *given)[1])

    def share(state: Array, index: int) -> Tick:
        inside.clear()
        tick = racer(state, index)
        return tick._replace(milliseconds=1e6 * sum(inside) / tick.milliseconds)  # a time of one second is all

    with mock.patch.object(method, "call", timed):
        return float(race(problem, {"": share}, 1)[""].times.mean())


def cold(contestants: Mapping[str, Any], judge: Callable[..., tuple[float, float]], rounds: int) -> Results:
    """Solve with every contestant in turn, and judge the last answers.

    Args:
        contestants: ours or peers. A call solves cold and returns the time that counts [s]; ``answer``, ``status`` and
            ``iterations`` are of the last one, empty and 0 where a solver does not tell.
        judge: violation and cost of an answer.
        rounds: that count.
    """
    times, results = interleave(contestants, rounds, slow=SLOW), Results()
    for name, one in contestants.items():
        found = times[name], one.status, one.iterations, *judge(*one.answer)
        results[name] = Result(*found, getattr(one, "inside", np.nan))
    return results


def loops(problem: Problem, rounds: int) -> Results:
    """Closed loops of ours and of acados' real-time iteration, which begins at a converged plan."""
    from benchmarks.acados_peer import Acados

    ours = {name: Whole(stated(problem, "numpy"), solver).control for name, solver in LOOPS.items()}
    plan, racers = on(problem, InteriorPoint()), dict(ours)
    plan()
    for soft in (False, True)[: 1 + problem.blocked]:
        peer = Acados(problem, TOLERANCE, soft, single=True)
        peer.plan, racers[f"acados RTI{', soft' if soft else ''}"] = plan.answer, peer.control
    results = race(problem, racers, rounds)
    for name in list(ours)[:2]:
        results[name].inside = compiled_share(problem, ours[name])
    return results


def colds(problem: Problem, rounds: int) -> Results:
    """Cold solves by ours, SQP of acados and, where states are vectors, SNOPT and crocoddyl."""
    from benchmarks.acados_peer import Acados
    from benchmarks.python_peers import Crocoddyl, Snopt

    contestants: dict[str, Any] = {name: on(problem, solver) for name, solver in COLD.items()}
    for soft in (False, True)[: 1 + problem.blocked]:
        for steps in ("full", "merit", "corrected"):
            name = f"acados SQP, {steps}{', soft' if soft else ''}"
            contestants[name] = Acados(problem, TOLERANCE, soft, steps=steps)
    if not isinstance(problem, Quadrotor):
        contestants["SNOPT (drake)"] = Snopt(problem, TOLERANCE)
        contestants |= {} if problem.blocked else {"Box-FDDP (crocoddyl)": Crocoddyl(problem, TOLERANCE)}
    return cold(contestants, partial(judge, problem), rounds)


def graph_part(rounds: int) -> Found:
    """A pose graph with jaxls."""
    from benchmarks import jaxls_peer

    case = cases()[0]
    graph, _, guess = case.pose_graph.graph()
    contestants: dict[str, Any] = {one.name: Ours(one, graph, fg.Guess(guess)) for one in backends("lm", "gn").values()}
    contestants["jaxls"] = jaxls_peer.pose_graph(case.pose_graph)
    return {case.name: cold(contestants, lambda found: (0.0, case.pose_graph.with_poses(found).chi2()), rounds)}


def constrained_part(rounds: int) -> Found:
    """Control problems with jaxls' augmented Lagrangian."""
    from benchmarks import jaxls_peer

    found, ours = {}, backends("ipm", "alm", tolerance=TOLERANCE).values()
    for problem in problems()[0], problems()[2]:
        contestants: dict[str, Any] = {one.name: on(problem, one) for one in ours}
        contestants["jaxls"] = jaxls_peer.augmented(problem)
        found[problem.title] = cold(contestants, partial(judge, problem), rounds)
    return found


def rendered(found: Found, ours: Iterable[str], of: Of, shares: str, shown_as: Of) -> str:
    """Table of ratios, and table of all results.

    Args:
        found: results.
        ours: contestants that are compared with all others.
        of: (rounds,) numbers of which there are ratios, by what their heading ends with.
        shares: heading of `inside`.
        shown_as: numbers that are shown, by heading.
    """
    names, ratios, facts = list(ours), [], []
    for title, results in found.items():
        for name, one in results.items():
            if name not in names:
                cells = (compared(results, mine, name, what) for mine in names for what in of.values())
                ratios.append((title, name, *cells))
            times = (number(what(one.times)) for what in shown_as.values())
            share = "-" if np.isnan(one.inside) else f"{100.0 * one.inside:.0f} %"
            judged, iterated = (
                one.refused(best(results)) or "accepted",
                f"{one.iterations or np.nan:.3g}".replace("nan", "-"),
            )
            facts.append((title, name, judged, iterated, *times, share, f"{one.violation:.1e}", f"{one.cost:.6g}"))
    heads = [f"{mine}{what}" for mine in names for what in of]
    every = ("problem", "solver", "judged", "iterations", *shown_as, shares, "violation", "cost")
    return f"{table(('problem', 'peer', *heads), ratios, 2)}\n\n{table(every, facts, 3)}"


MEDIAN: Of = {"median [ms]": lambda times: 1e3 * np.median(times)}
TICKS: Of = {
    "mean [us]": lambda times: 1e6 * times.mean(),
    "p99 [us]": lambda times: 1e6 * np.percentile(times, 99),
}
TAILS: Of = {", mean": lambda times: times.mean(axis=1), ", p99": lambda times: np.percentile(times, 99, axis=1)}
WHOLE: Of = {"": lambda times: times}


def each(measure: Callable[[Problem, int], Results], rounds: int) -> Found:
    """Results of all problems."""
    return {problem.title: measure(problem, rounds) for problem in problems()}


PARTS: Columns[int] = {
    "Ticks": lambda rounds: rendered(each(loops, rounds), LOOPS, TAILS, "compiled", TICKS),
    "Cold solves": lambda rounds: rendered(each(colds, rounds), COLD, WHOLE, "left out", MEDIAN),
    "Pose graph": lambda rounds: rendered(
        graph_part(rounds), ("LevenbergMarquardt", "GaussNewton"), WHOLE, "left out", MEDIAN
    ),
    "Constraints in jaxls": lambda n: rendered(
        constrained_part(n), ("InteriorPoint", "AugmentedLagrangian"), WHOLE, "left out", MEDIAN
    ),
    "Machine": lambda rounds: machine(),
}
"""Sections of the page by heading, each made in a process of its own."""


def tables(rounds: int) -> str:
    """Every part, measured in the peers' environment.

    Raises:
        Unavailable: it has not been built.
    """
    if not (HOME / "ready").is_file():
        raise Unavailable(f"{HOME.name} with the peers is not there: build it with `make peers`")
    texts, command = [], [str(HOME / "bin" / "python"), "-m", "benchmarks.peers"]
    with tempfile.TemporaryDirectory() as folder:
        for heading in tqdm(PARTS, unit="part"):
            path = Path(folder) / "text.md"  # solvers write what they like to the standard output
            given = [heading, str(rounds), str(path)]
            subprocess.run([*command, *given], cwd=CHECKOUT, stdout=subprocess.DEVNULL, check=True)
            texts.append(f"### {heading}\n\n{path.read_text(encoding='utf-8')}")
    return "\n\n".join(texts)


class Page(Timing):
    """The page: packages and machine are those of the processes that measure."""

    def run(self, name: str, chosen: argparse.Namespace) -> str:
        """Measure everything; the tables."""
        return self.tables(chosen.rounds or self.rounds)


STUDY = Page(tables, 7)

if __name__ == "__main__":
    pin()
    heading, count, out = sys.argv[1:]
    Path(out).write_text(PARTS[heading](int(count)), encoding="utf-8")
