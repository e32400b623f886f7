"""Sixteen optimal control problems of a unicycle with known optima, solved cold by both constrained backends.

    python -m benchmarks.reference_problems [--rounds R]

minimise   sum_k 1/2 |x_k - xr_k|_W^2 + 1/2 |u_k - ur_k|_Wu^2  (+ 1/2 |x_N - xr_N|_WN^2)
subject to x_0 given, x_{k+1} = f(x_k, u_k), |u| <= 1, and five discs to be avoided at every node.

The listed optima were found by IPOPT 3.14 at tolerance 1e-9 from the same guess. With discs there are several local
optima, one for each choice of side, so a lower cost is another optimum and not a mistake. If casadi is installed, its
IPOPT (exact Hessian, MUMPS) solves the same problems in turn with ours, for the times. Writes
docs/reference-problems.md.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.report import CHECKOUT, OUT, machine, put_results, table
from unifg.models import obstacles, unicycle
from unifg.solvers import SQP, AugmentedLagrangian
from unifg.typing import Array

DT = 0.1  # [s]
LIMIT = 1.0  # [m/s] and [rad/s]
STAGE, TERMINAL, EFFORT = np.array([10.0, 10.0, 1.0]), np.array([50.0, 50.0, 5.0]), np.array([0.1, 0.1])
HORIZONS = (20, 50)
SAME = 1e-5  # relative difference below which two costs count as one optimum

STARTS = {
    "straight": (0.0, 0.5, -0.4),
    "curve": (0.0, -0.4, 0.6),
    "ahead": (0.0, 0.0, 0.0),
    "behind": (0.0, 0.0, 0.3),
}
RING = ((0.6, 2.2), (1.3, 1.8), (2.2, 2.2), (3.2, 1.8), (4.2, 2.2))  # angle [rad] and distance [m] from (0, 2)
DISCS = {  # x, y, radius [m]
    "straight": ((1.6, -0.15, 0.4), (3.0, 0.25, 0.45), (5.0, -0.2, 0.5), (6.6, 0.3, 0.4), (8.2, -0.25, 0.4)),
    "curve": tuple((d * np.sin(a), 2.0 - d * np.cos(a), 0.35) for a, d in RING),
    "ahead": ((1.2, 0.55, 0.4), (2.1, 0.4, 0.35), (0.6, -0.5, 0.3), (3.6, 1.5, 0.3), (2.0, 1.6, 0.3)),
    "behind": ((-1.0, 0.25, 0.3), (-1.9, -0.2, 0.3), (0.7, 0.6, 0.3), (-0.4, -0.8, 0.3), (-3.0, 0.15, 0.3)),
}
# (instance, with discs, N): known local optima, the one reached by IPOPT from the cold guess first.
OPTIMA: dict[tuple[str, bool, int], tuple[float, ...]] = {
    ("straight", False, 20): (6.40874,),
    ("straight", False, 50): (6.40879,),
    ("straight", True, 20): (9.56973,),
    ("straight", True, 50): (12.98617,),
    ("curve", False, 20): (3.74998,),
    ("curve", False, 50): (3.74998,),
    ("curve", True, 20): (5.32781, 5.33182),
    ("curve", True, 50): (6.91008,),
    ("ahead", False, 20): (561.41452,),
    ("ahead", False, 50): (558.59179,),
    ("ahead", True, 20): (579.75063,),
    ("ahead", True, 50): (608.83744,),
    ("behind", False, 20): (54.47372,),
    ("behind", False, 50): (59.47520,),
    ("behind", True, 20): (54.47522,),
    ("behind", True, 50): (63.46789, 63.46577, 79.43),
}


@dataclass(frozen=True)
class Problem:
    """The numbers of one problem.

    Attributes:
        instance: name.
        blocked: whether the discs are there.
        horizon: N.
    """

    instance: str
    blocked: bool
    horizon: int

    @property
    def name(self) -> str:
        """For the tables."""
        return f"{self.instance}{', discs' if self.blocked else ''}, N = {self.horizon}"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    @property
    def discs(self) -> Array:
        """(M, 3) x, y, radius [m]."""
        return np.array(DISCS[self.instance] if self.blocked else np.zeros((0, 3)), dtype=np.float64)

    def reference(self) -> tuple[Array, Array]:
        """Reference states (N + 1, 3), headings not wrapped, and controls (N, 2)."""
        t = DT * np.arange(self.horizon + 1)
        zero = np.zeros_like(t)
        states, control = {
            "straight": ((0.8 * t, zero, zero), (0.8, 0.0)),
            "curve": ((2.0 * np.sin(0.35 * t), 2.0 - 2.0 * np.cos(0.35 * t), 0.35 * t), (0.7, 0.35)),
            "ahead": ((zero + 3.0, zero + 1.0, zero), (0.0, 0.0)),
            "behind": ((-0.5 * t, zero, zero + np.pi), (0.5, 0.0)),
        }[self.instance]
        return np.column_stack(states), np.tile(control, (self.horizon, 1))

    def guess(self) -> tuple[Array, Array]:
        """The reference itself, even through the discs; ``ahead`` has none and begins with the robot at rest."""
        states, controls = self.reference()
        if self.instance == "ahead":
            states[:] = STARTS["ahead"]
        states[0] = STARTS[self.instance]
        return states, controls


def problems() -> list[Problem]:
    """All sixteen."""
    return [Problem(*numbers) for numbers in itertools.product(STARTS, (False, True), HORIZONS)]


def as_graph(problem: Problem) -> tuple[fg.Graph, fg.Guess]:
    """The problem as a factor graph, and its cold guess."""
    n = problem.horizon
    reference, cruise = problem.reference()
    graph = fg.Graph()
    x = graph.variables("pose", fg.SE2, n + 1)
    u = graph.variables("control", fg.Rn(2), n)
    stages = graph.data("stages", reference[:-1], each=True)
    end = graph.data("end", reference[-1])
    effort = graph.data("effort", cruise, each=True)
    graph.fix(x[0], STARTS[problem.instance])
    graph.minimize(unicycle.tracking, x[:-1], stages, sigma=STAGE**-0.5, name="tracking")
    graph.minimize(unicycle.tracking, x[-1], end, sigma=TERMINAL**-0.5, name="terminal")
    graph.minimize(fg.prior, u, effort, sigma=EFFORT**-0.5, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], DT, lower=0.0, upper=0.0, name="dynamics")
    graph.bound(u, lower=-LIMIT, upper=LIMIT, name="limits")
    if problem.blocked:
        discs = problem.discs
        graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2], lower=0.0, name="discs")
    states, controls = problem.guess()
    return graph, fg.Guess({x: states, u: controls})


@dataclass
class Outcome:
    """What one solver made of one problem.

    Attributes:
        status: in words.
        iterations: of the solver.
        cost: with its 1/2.
        routes: how many subproblems each QP route solved.
        times: one per round [ms].
    """

    status: str = ""
    iterations: int = 0
    cost: float = np.nan
    routes: dict[str, int] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))


Attempt = Callable[[Outcome], None]


def attempt(solver: fg.Solver, problem: Problem) -> Attempt:
    """A cold solve by one of our backends: graph compiled before, workspaces and factorisations timed."""
    graph, guess = as_graph(problem)

    def solve(outcome: Outcome) -> None:
        run = solver.prepare(graph)
        begin = time.perf_counter()
        solution = run.solve(guess)
        outcome.times.append(1e3 * (time.perf_counter() - begin))
        outcome.status = solution.status.name.lower().replace("_", " ")
        outcome.iterations, outcome.cost = solution.iterations, solution.cost
        routes = (str(row.details.get("qp", "")).partition(":")[0] for row in solution.history)
        outcome.routes = dict(Counter(route for route in routes if route not in ("", "none")))

    return solve


def attempt_ipopt(problem: Problem) -> Attempt:
    """The same by IPOPT through casadi: expressions built and differentiated before, the solve timed."""
    import casadi as ca

    n = problem.horizon
    x, u = ca.SX.sym("x", 3, n + 1), ca.SX.sym("u", 2, n)
    reference, cruise = problem.reference()
    start, weights = ca.DM(STARTS[problem.instance]), [STAGE] * n + [TERMINAL]
    cost: Any = 0.0
    for k in range(n + 1):
        error = x[:, k] - reference[k]
        cost += 0.5 * ca.dot(ca.DM(weights[k]) * error, error)
    equalities, clearances = [x[:, 0] - start], []
    for k in range(n):
        deviation = u[:, k] - cruise[k]
        cost += 0.5 * ca.dot(ca.DM(EFFORT) * deviation, deviation)
        heading = x[2, k] + 0.5 * DT * u[1, k]
        moved = ca.vertcat(DT * u[0, k] * ca.cos(heading), DT * u[0, k] * ca.sin(heading), DT * u[1, k])
        equalities.append(x[:, k + 1] - x[:, k] - moved)
        # Squared distances: the plain ones have no derivative at a centre.
        clearances += [ca.sumsqr(x[:2, k + 1] - disc[:2]) - disc[2] ** 2 for disc in problem.discs]
    unknowns = ca.vertcat(ca.vec(x), ca.vec(u))
    constraints = ca.vertcat(*equalities, *clearances)
    options: Any = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6}}
    solver = ca.nlpsol("solver", "ipopt", {"x": unknowns, "f": cost, "g": constraints}, options)
    states, controls = problem.guess()
    bound = np.concatenate([np.full(3 * (n + 1), np.inf), np.full(2 * n, LIMIT)])
    upper = np.concatenate([np.zeros(3 * (n + 1)), np.full(len(clearances), np.inf)])
    numbers: Any = {"x0": np.concatenate([states.ravel(), controls.ravel()]), "lbx": -bound, "ubx": bound, "lbg": 0.0}

    def solve(outcome: Outcome) -> None:
        begin = time.perf_counter()
        answer = solver(**numbers, ubg=upper)
        outcome.times.append(1e3 * (time.perf_counter() - begin))
        statistics = solver.stats()
        outcome.status = "converged" if statistics["success"] else str(statistics["return_status"])
        outcome.iterations, outcome.cost = int(statistics["iter_count"]), float(answer["f"])

    return solve


def measure(problem: Problem, rounds: int) -> dict[str, Outcome]:
    """Solve a problem with every solver in turn, ``rounds`` times: a slow moment of the machine meets all of them."""
    attempts = {
        "alm": attempt(AugmentedLagrangian(), problem),
        "sqp": attempt(SQP(), problem),
    }
    if find_spec("casadi") is not None:
        attempts["ipopt"] = attempt_ipopt(problem)
    outcomes = {name: Outcome() for name in attempts}
    for _ in range(rounds):
        for name, solve in attempts.items():
            solve(outcomes[name])
    return outcomes


def verdict(problem: Problem, outcome: Outcome) -> str:
    """How the cost found compares with the known optima."""
    if outcome.status != "converged":
        return "not solved"
    relative = [(outcome.cost - known) / known for known in problem.optima]
    if abs(relative[0]) < SAME:
        return "listed"
    if min(map(abs, relative)) < SAME:
        return "listed alternative"
    return "lower" if relative[0] < 0.0 else f"other, {100.0 * relative[0]:+.2g} %"


def render(results: dict[Problem, dict[str, Outcome]], rounds: int) -> str:
    """The results as Markdown."""
    head = ("problem", "solver", "status", "optimum", "cost", "listed", "iterations", "ms", "times IPOPT", "QPs")
    lines = []
    for problem, outcomes in results.items():
        peer = outcomes.get("ipopt")
        for name, outcome in outcomes.items():
            ratio = "-" if peer is None or name == "ipopt" else f"{outcome.median / peer.median:.1f}"
            lines.append(
                (
                    problem.name, name, outcome.status, verdict(problem, outcome), f"{outcome.cost:.5f}",
                    f"{problem.optima[0]:.5f}", str(outcome.iterations), f"{outcome.median:.1f}", ratio,
                    ", ".join(f"{count} {route}" for route, count in outcome.routes.items()) or "-",
                )
            )  # fmt: skip
    parts = [_summary(results), table(head, lines, text=4)]
    packages = ("unifg", "numpy", "scipy", "osqp", "piqp", "qdldl")
    peer_package = ("casadi",) if any("ipopt" in outcomes for outcomes in results.values()) else ()
    parts.append(
        f"Median of {rounds} interleaved cold solves, tolerance 1e-6 each. {machine(*packages, *peer_package)}"
    )
    return "\n\n".join(parts)


def _summary(results: dict[Problem, dict[str, Outcome]]) -> str:
    names = dict.fromkeys(name for outcomes in results.values() for name in outcomes)
    lines = []
    for name in names:
        mine = {problem: outcomes[name] for problem, outcomes in results.items()}
        peers = [outcomes["ipopt"].median for outcomes in results.values() if "ipopt" in outcomes]
        times = np.array([outcome.median for outcome in mine.values()])
        ratio = float(np.exp(np.mean(np.log(times / np.array(peers))))) if len(peers) == len(times) else np.nan
        found = [verdict(problem, outcome) for problem, outcome in mine.items()]
        lines.append(
            (
                name,
                f"{sum(outcome.status == 'converged' for outcome in mine.values())} / {len(mine)}",
                f"{sum(word == 'listed' for word in found)} / {len(mine)}",
                f"{np.median(times):.1f}",
                f"{times.max():.1f}",
                "-" if name == "ipopt" or np.isnan(ratio) else f"{ratio:.1f}",
            )
        )
    head = ("solver", "converged", "listed optimum", "median [ms]", "slowest [ms]", "times IPOPT (geometric mean)")
    return table(head, lines)


def main(arguments: list[str] | None = None) -> int:
    """Solve everything and write the tables; 0 only if our backends converge everywhere."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reference_problems", description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="solves of every problem by every solver")
    options = parser.parse_args(arguments)
    if find_spec("casadi") is None:
        print("casadi is not installed: no comparison with IPOPT.")
    results = {problem: measure(problem, options.rounds) for problem in tqdm(problems(), unit="problem")}
    text = render(results, options.rounds)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "reference-problems.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    put_results(CHECKOUT / "docs" / "reference-problems.md", "Reference problems", text)
    ours = [outcome for outcomes in results.values() for name, outcome in outcomes.items() if name != "ipopt"]
    return 0 if all(outcome.status == "converged" for outcome in ours) else 1


if __name__ == "__main__":
    raise SystemExit(main())
