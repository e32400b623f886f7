"""Peers in one run: acados, SNOPT, crocoddyl and jaxls, in turn with ours on the same problems.

They live in an environment of their own, which ``make peers`` builds; each part of the page is a process there.
Problems are stated as plain NumPy functions on our side. Answers are compared where one judge accepts both.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import thread_time
from typing import Any, Protocol
from unittest import mock

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.control_loops import CONTACT, STEPS, Drive
from benchmarks.control_peers import MODELS
from benchmarks.own_functions import Way
from benchmarks.pose_graphs import cases
from benchmarks.report import CHECKOUT, machine, table, words
from benchmarks.runner import Unavailable
from benchmarks.timing import interleave, number, pin, ratio, shown
from problems.cart_pole import CartPole
from problems.control import Driver, Problem, Quadrotor, Tick, Unicycle
from unifg.solvers import SQP, InteriorPoint
from unifg.solvers.interior_point import method
from unifg.solvers.names import backends
from unifg.typing import Array

HOME = CHECKOUT / ".venv-peers"
TOLERANCE = 1e-4  # of every solver, of a violation [m, rad, m/s or the control's unit], and of an answer's cost
WORSE = 1e-2  # relative, from which a cost is another optimum
SLOW = 5.0  # a solve that takes longer is not repeated [s]
RTI = "acados RTI"
SAFE = InteriorPoint(tolerance=TOLERANCE, step_tolerance=np.inf, violation_tolerance=CONTACT)
LOOPS: dict[str, fg.Solver] = {
    "InteriorPoint, safe": SAFE,
    "InteriorPoint": InteriorPoint(tolerance=TOLERANCE),
    'SQP(qp="graph"), one iteration': SQP(tolerance=TOLERANCE, qp="graph", max_iterations=1),
}
COLD: dict[str, fg.Solver] = {
    "InteriorPoint": InteriorPoint(tolerance=TOLERANCE),
    'SQP(qp="graph")': SQP(tolerance=TOLERANCE, qp="graph"),
    "SQP": SQP(tolerance=TOLERANCE),
}


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


class Contestant(Protocol):
    """A solver of one problem, ready to solve; ours, and one for each peer.

    Attributes:
        answer: of the last solve, as a judge takes it.
        status: of the last solve, in words.
    """

    answer: Any
    status: str

    @property
    def iterations(self) -> int:
        """Of the last solve; 0 where the solver does not tell."""
        ...

    def __call__(self) -> float:
        """Solve from the cold guess; the time that counts [s]."""
        ...


class Racer(Protocol):
    """A contestant in a closed loop."""

    def control(self, state: Array, index: int) -> Tick:
        """One step, from what the last one ended with."""
        ...


class Ours:
    """A backend of ours on a graph, cold.

    Attributes:
        answer: values of the families in the last solve.
        status, iterations: of the last solve.
    """

    def __init__(self, solver: fg.Solver, graph: fg.Graph, guess: Any, families: tuple[fg.Family, ...]) -> None:
        """Prepare."""
        self._run, self._guess, self._families = solver.prepare(graph), guess, families
        self.status, self.iterations = "", 0
        self.answer: Any = None

    def __call__(self) -> float:
        """Solve; seconds."""
        begin = thread_time()
        solution = self._run.solve(self._guess)
        spent = thread_time() - begin
        self.status, self.iterations = words(solution.status), solution.iterations
        self.answer = [np.array(solution[family]) for family in self._families]
        return spent


def on(problem: Problem, solver: fg.Solver) -> Ours:
    """A backend on a control problem that is stated as NumPy functions."""
    stated = Way(problem, "numpy").formulation()
    return Ours(solver, stated.graph, stated.guess, (stated.x, stated.u))


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


class Judge:
    """Violation and cost of states and controls, by expressions of casadi and nothing of ours."""

    def __init__(self, problem: Problem) -> None:
        """Build the functions."""
        import casadi as ca

        error, gap = MODELS[problem.robot]
        x, y = (ca.SX.sym(name, len(problem.start)) for name in "xy")
        u = ca.SX.sym("u", len(problem.effort))
        self._problem = problem
        self._gap: Any = ca.Function("gap", [x, u, y], [gap(x, u, y, problem.dt)])
        self._error: Any = ca.Function("error", [x, y], [error(x, y)])

    def __call__(self, states: Array, controls: Array) -> tuple[float, float]:
        """Largest violation, in the unit of each row (distances, not squares), and cost."""
        p, (wanted, cruise) = self._problem, self._problem.reference()
        gaps = np.array(self._gap(states[:-1].T, controls.T, states[1:].T))
        off = np.array(self._error(states.T, wanted.T)).T
        outside = [np.abs(gaps).max(), np.abs(states[0] - p.start).max(), np.max(p.lower - controls)]
        outside += [np.max(controls - p.upper), max(map(p.penetration, states[1:]))]
        weights = np.vstack([np.tile(p.stage, (p.horizon, 1)), p.terminal])
        cost = 0.5 * np.sum(weights * off**2) + 0.5 * np.sum(p.effort * (controls - cruise) ** 2)
        return float(np.max([*outside, 0.0])), float(cost)


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

    def accepted(self, best: float = np.inf) -> str:
        """Reason for which the answer is not compared, empty if there is none."""
        if self.status not in ("", "converged"):
            return self.status
        if not self.violation <= TOLERANCE:
            return f"violates by {self.violation:.2g}"
        return "" if self.cost <= best * (1.0 + WORSE) + TOLERANCE else "another optimum"


Results = dict[str, Result]


def compared(results: Results, name: str, peer: str, of: Callable[[Array], Array]) -> str:
    """Ratio of times with its interval, only where the judge accepts both answers.

    Args:
        results: all of one problem.
        name: of ours.
        peer: beside it.
        of: (rounds,) numbers to be compared, of times.
    """
    if peer not in results:
        return "-"
    best = min((one.cost for one in results.values() if not one.accepted()), default=np.inf)
    for who, refused in ((name, results[name].accepted(best)), (peer, results[peer].accepted(best))):
        if refused:
            return f"{'not compared' if who == name else 'peer'}: {refused}"
    return shown(ratio(of(results[name].times), of(results[peer].times)))


def race(problem: Problem, racers: Mapping[str, Racer], rounds: int) -> Results:
    """Drive every robot one step in turn, in random order, ``rounds`` loops after one that is not counted."""
    rng, loops = np.random.default_rng(0), list[dict[str, Drive]]()
    for _ in range(rounds + 1):
        loop = {name: Drive() for name in racers}
        states, controls = dict.fromkeys(racers, problem.start), dict[str, Array]()
        for index in range(STEPS + 1):
            for name in rng.permutation(list(racers)).tolist():
                drive = loop[name]
                if index:
                    drive.cost += problem.stage_cost(states[name], controls[name], index - 1)
                    states[name] = problem.plant(states[name], controls[name], index - 1)
                    drive.penetration = max(drive.penetration, problem.penetration(states[name]))
                tick = racers[name].control(states[name], index)
                controls[name] = tick.control
                if tick.status not in ("converged", "stop rule", "iteration limit"):
                    drive.failures[tick.status] += 1
                if index:
                    drive.times.append(1e-3 * tick.milliseconds)
                    drive.iterations.append(tick.iterations)
        loops.append(loop)
    return {
        name: Result(
            np.array([loop[name].times for loop in loops[1:]]),
            ", ".join(f"{count} x {status}" for status, count in last.failures.items()) or "converged",
            float(np.mean(last.iterations)), max(last.penetration, 0.0), last.cost,
        )
        for name, last in loops[-1].items()
    }  # fmt: skip


def compiled_share(problem: Problem, racer: Racer) -> float:
    """Share of the time of ticks that the interior point spends in compiled code, in a loop of its own."""
    inside, call, state, whole = [0.0], vars(method)["call"], problem.start, 0.0

    def timed(*given: Any) -> None:
        begin = thread_time()
        call(*given)
        inside[0] += thread_time() - begin

    with mock.patch.object(method, "call", timed):
        for index in range(STEPS + 1):
            inside[0] = 0.0 if index == 0 else inside[0]
            tick = racer.control(state, index)
            whole += tick.milliseconds if index else 0.0
            state = problem.plant(state, tick.control, index)
    return 1e3 * inside[0] / whole


def cold(contestants: Mapping[str, Contestant], judge: Callable[..., tuple[float, float]], rounds: int) -> Results:
    """Solve with every contestant in turn, and judge the last answers."""
    times, results = interleave(contestants, rounds, slow=SLOW), Results()
    for name, one in contestants.items():
        found = times[name], one.status, one.iterations, *judge(*one.answer)
        results[name] = Result(*found, getattr(one, "inside", np.nan))
    return results


def loops(problem: Problem, rounds: int) -> Results:
    """Closed loops of ours and of acados' real-time iteration, all begun at one converged plan."""
    from benchmarks.acados_peer import Acados

    plan = on(problem, InteriorPoint())
    plan()
    ours = {name: Whole(Way(problem, "numpy"), solver) for name, solver in LOOPS.items()}
    ways = {RTI: False} | ({f"{RTI}, soft": True} if problem.blocked else {})
    theirs = {name: Acados(problem, TOLERANCE, soft, single=True) for name, soft in ways.items()}
    for peer in theirs.values():
        peer.plan = plan.answer
    results = race(problem, {**ours, **theirs}, rounds)
    for name in list(LOOPS)[:2]:
        results[name].inside = compiled_share(problem, ours[name])
    return results


def colds(problem: Problem, rounds: int) -> Results:
    """Cold solves by ours, SQP of acados and, where states are vectors, SNOPT and crocoddyl."""
    from benchmarks.acados_peer import Acados
    from benchmarks.python_peers import Crocoddyl, Snopt

    contestants: dict[str, Contestant] = {name: on(problem, solver) for name, solver in COLD.items()}
    for soft in (False, True) if problem.blocked else (False,):
        for steps in ("full", "merit", "corrected"):
            name = f"acados SQP, {steps}{', soft' if soft else ''}"
            contestants[name] = Acados(problem, TOLERANCE, soft, steps=steps)
    if not isinstance(problem, Quadrotor):
        contestants["SNOPT (drake)"] = Snopt(problem, TOLERANCE)
        if not problem.blocked:
            contestants["Box-FDDP (crocoddyl)"] = Crocoddyl(problem, TOLERANCE)
    return cold(contestants, Judge(problem), rounds)


def facts(found: Mapping[str, Results], counted: str, time: Mapping[str, Callable[[Array], float]], inside: str) -> str:
    """Table of all results.

    Args:
        found: by problem.
        counted: heading of the iterations.
        time: columns with times [s], by heading; shown a million times as large where these name microseconds.
        inside: heading of the shares.
    """
    lines = []
    for title, results in found.items():
        best = min((one.cost for one in results.values() if not one.accepted()), default=np.inf)
        for name, one in results.items():
            times = [number((1e6 if "us" in head else 1e3) * of(one.times)) for head, of in time.items()]
            share = "-" if np.isnan(one.inside) else f"{100.0 * one.inside:.0f} %"
            shares = one.accepted(best) or "accepted", f"{one.iterations:.3g}" if one.iterations else "-", *times, share
            lines.append((title, name, *shares, f"{one.violation:.1e}", f"{one.cost:.6g}"))
    return table(("problem", "solver", "judged", counted, *time, inside, "violation", "cost"), lines, 3)


def ratios(found: Mapping[str, Results], ours: list[str], of: Mapping[str, Callable[[Array], Array]]) -> str:
    """Table of times of ours over those of every peer."""
    lines = [
        (title, peer, *(compared(results, name, peer, what) for name in ours for what in of.values()))
        for title, results in found.items()
        for peer in results
        if peer not in ours
    ]
    return table(("problem", "peer", *(f"{name}{what}" for name in ours for what in of)), lines, 2)


def ticks_part(rounds: int) -> str:
    """Closed loops."""
    found = {problem.title: loops(problem, rounds) for problem in problems()}
    times: dict[str, Callable[[Array], float]] = {
        "mean [us]": lambda times: float(np.mean(times)),
        "p99 [us]": lambda times: float(np.percentile(times, 99)),
    }
    of: dict[str, Callable[[Array], Array]] = {
        ", mean": lambda times: times.mean(axis=1),
        ", p99": lambda times: np.percentile(times, 99, axis=1),
    }
    said = "Times of ours over those of the peer, with 95 % intervals."
    return "\n\n".join([said, ratios(found, list(LOOPS), of), facts(found, "iterations", times, "compiled")])


def cold_part(rounds: int) -> str:
    """Cold solves."""
    found = {problem.title: colds(problem, rounds) for problem in problems()}
    return beside(found, list(COLD))


def beside(found: Mapping[str, Results], ours: list[str]) -> str:
    """Tables of cold solves."""
    median = {"median [ms]": lambda times: float(np.median(times))}
    return f"{ratios(found, ours, {'': lambda times: times})}\n\n{facts(found, 'iterations', median, 'left out')}"


def between(a: Array, b: Array, measured: Array) -> Array:
    """(n, 3) logarithm of measured poses' differences."""
    off: Array = fg.SE2.log(fg.SE2.between(measured, fg.SE2.between(a, b)))
    return off


def relative(a: Array, b: Array) -> Array:
    """(n, 3) poses b as seen from poses a."""
    (x, y, turn), cosine, sine = (b - a).T, np.cos(a[:, 2]), np.sin(a[:, 2])
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, turn], axis=1)


def graph_part(rounds: int) -> str:
    """A pose graph with jaxls."""
    from benchmarks import jaxls_peer

    case = cases()[0]
    edges, poses = case.pose_graph.edges, case.pose_graph.poses
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, len(poses))
    graph.fix(x[0], poses[0])
    graph.minimize(between, x[edges.first], x[edges.second], edges.measured, information=edges.information)
    solvers = backends("lm", "gn")
    contestants: dict[str, Contestant] = {name: Ours(one, graph, {x: poses}, (x,)) for name, one in solvers.items()}
    contestants["jaxls"] = jaxls_peer.pose_graph(case.pose_graph)

    def judge(found: Array) -> tuple[float, float]:
        turned = relative(edges.measured, relative(found[edges.first], found[edges.second]))
        half = 0.5 * turned[:, 2]
        scale = np.where(half == 0.0, 1.0, half / np.tan(half + (half == 0.0)))
        x, y, angle = turned.T
        off = np.stack([scale * x + half * y, scale * y - half * x, angle], axis=1)  # logarithm
        return 0.0, float(np.einsum("ki,kij,kj", off, edges.information, off))

    return beside({case.name: cold(contestants, judge, rounds)}, list(solvers))


def constrained_part(rounds: int) -> str:
    """Control problems with jaxls' augmented Lagrangian."""
    from benchmarks import jaxls_peer

    found, ours = {}, backends("ipm", "alm", tolerance=TOLERANCE)
    for problem in problems()[0], problems()[2]:
        contestants: dict[str, Contestant] = {name: on(problem, solver) for name, solver in ours.items()}
        contestants["jaxls, augmented Lagrangian"] = jaxls_peer.augmented(problem)
        found[problem.title] = cold(contestants, Judge(problem), rounds)
    return beside(found, list(ours))


PARTS: dict[str, Callable[[int], str]] = {
    "Ticks": ticks_part,
    "Cold solves": cold_part,
    "Pose graph": graph_part,
    "Constraints in jaxls": constrained_part,
    "Machine": lambda rounds: machine(),
}
"""Sections of the page by heading, each made in a process of its own."""


@dataclass(frozen=True)
class Page:
    """The page.

    Attributes:
        rounds: of times.
    """

    rounds: int = 7

    def run(self, name: str, chosen: argparse.Namespace) -> str:
        """Measure every part in the peers' environment; the tables.

        Raises:
            Unavailable: it has not been built.
        """
        if not (HOME / "ready").is_file():
            raise Unavailable(f"{HOME.name} is not there, which has the peers: build it with `make peers`")
        texts, command = [], [str(HOME / "bin" / "python"), "-m", "benchmarks.peers"]
        with tempfile.TemporaryDirectory() as folder:
            for heading in tqdm(PARTS, unit="part"):
                path = Path(folder) / "text.md"  # solvers write what they like to the standard output
                given = [heading, str(chosen.rounds or self.rounds), str(path)]
                subprocess.run([*command, *given], cwd=CHECKOUT, stdout=subprocess.DEVNULL, check=True)
                texts.append(f"### {heading}\n\n{path.read_text()}")
        return "\n\n".join(texts)


STUDY = Page()

if __name__ == "__main__":
    pin()
    heading, count, out = sys.argv[1:]
    Path(out).write_text(PARTS[heading](int(count)))
