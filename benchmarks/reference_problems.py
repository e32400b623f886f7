"""Sixteen optimal control problems of a unicycle with known optima, solved cold by the constrained backends.

    python -m benchmarks.reference_problems [--rounds R]

minimise   sum_k 1/2 |x_k - xr_k|_W^2 + 1/2 |u_k - ur_k|_Wu^2  (+ 1/2 |x_N - xr_N|_WN^2)
subject to x_0 given, x_{k+1} = f(x_k, u_k), |u| <= 1, and five discs to be avoided at every node.

The listed optima were found by IPOPT 3.14 at tolerance 1e-9 from the same guess. With discs there are several local
optima, one for each choice of side, so a lower cost is another optimum and not a mistake. If casadi is installed, its
IPOPT (MUMPS) and fatrop, both with exact Hessians, solve the same problems in turn with ours, for the times, and IPOPT
starts from every answer of ours that is in no list, to see whether it is an optimum. The same solvers then drive the
robot for a hundred steps (:mod:`benchmarks.closed_loop`). Writes docs/reference-problems.md.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks import closed_loop
from benchmarks.closed_loop import Formulation, Peer
from benchmarks.report import CHECKOUT, OUT, machine, put_results, table
from benchmarks.unicycle_problems import Problem, problems
from unifg.solvers import SQP
from unifg.solvers.names import backends
from unifg.typing import Array

SAME = 1e-5  # relative difference below which two costs count as one optimum
STAYS = 1e-6  # and below which IPOPT has stayed where it was started
GOOD = 1e-4  # KKT numbers below which a problem counts as solved
SLOW = 2000.0  # [ms]; a slower solve is not repeated
PEERS = ("ipopt", "fatrop")
ALONE = "sqp, OSQP alone"  # needs no success for the exit code: it shows what the fallback is for


@dataclass
class Outcome:
    """What one solver made of one problem.

    Attributes:
        status: in words.
        iterations: of the solver.
        cost: with its 1/2.
        routes: how many subproblems each QP route solved.
        times: one per round [ms].
        kkt: largest KKT number, not a number for a peer.
        states, controls: where it ended.
        refined: cost at which IPOPT ends when started there; not a number where that was not tried.
    """

    status: str = ""
    iterations: int = 0
    cost: float = np.nan
    routes: dict[str, int] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)
    kkt: float = np.nan
    states: Array = field(default_factory=lambda: np.zeros((0, 3)))
    controls: Array = field(default_factory=lambda: np.zeros((0, 2)))
    refined: float = np.nan

    @property
    def good(self) -> bool:
        """Whether it is a KKT point to what counts as solved."""
        return self.status == "converged" or self.kkt <= GOOD

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))


Attempt = Callable[[Outcome], None]


def attempt(solver: fg.Solver, problem: Problem) -> Attempt:
    """A cold solve by one of our backends: graph compiled before, workspaces and factorisations timed."""
    formulation = Formulation(problem)

    def solve(outcome: Outcome) -> None:
        run = solver.prepare(formulation.graph)
        begin = time.thread_time()
        solution = run.solve(formulation.guess)
        outcome.times.append(1e3 * (time.thread_time() - begin))
        outcome.status = solution.status.name.lower().replace("_", " ")
        outcome.iterations, outcome.cost = solution.iterations, solution.cost
        outcome.kkt = max(solution.stationarity, solution.violation, solution.complementarity)
        outcome.states, outcome.controls = solution[formulation.x], solution[formulation.u]
        routes = (str(row.details.get("qp", "")).partition(":")[0] for row in solution.history)
        outcome.routes = dict(Counter(route for route in routes if route not in ("", "none")))

    return solve


def attempt_peer(problem: Problem, plugin: str) -> Attempt:
    """A cold solve through casadi: expressions built and differentiated before, the solve timed."""
    peer = Peer(problem, plugin)
    guess = problem.guess()

    def solve(outcome: Outcome) -> None:
        outcome.times.append(peer.solve(*guess))
        outcome.status, outcome.iterations, outcome.cost = peer.status, peer.iterations, peer.cost

    return solve


def refine(problem: Problem, outcome: Outcome) -> float:
    """Cost at which IPOPT ends from an answer; its barrier begins small, or it would leave any answer at a limit."""
    near = {"bound_push": 1e-9, "bound_frac": 1e-9, "slack_bound_push": 1e-9, "slack_bound_frac": 1e-9}
    peer = Peer(problem, "ipopt", **{**near, "mu_init": 1e-8, "tol": 1e-9})
    states = outcome.states.copy()
    states[:, 2] = np.unwrap(states[:, 2])
    peer.solve(states, outcome.controls)
    return peer.cost if peer.status == "converged" else np.inf


def measure(problem: Problem, rounds: int) -> dict[str, Outcome]:
    """Solve a problem with every solver in turn, ``rounds`` times: a slow moment of the machine meets all of them."""
    attempts = {name: attempt(solver, problem) for name, solver in backends("ipm", "alm", "sqp").items()}
    attempts[ALONE] = attempt(SQP(fallback=None, qp_iterations=4000), problem)
    compare = find_spec("casadi") is not None
    if compare:
        attempts |= {name: attempt_peer(problem, name) for name in PEERS}
    outcomes = {name: Outcome() for name in attempts}
    for _ in range(rounds):
        for name, solve in attempts.items():
            if max(outcomes[name].times, default=0.0) < SLOW:
                solve(outcomes[name])
    for name, outcome in outcomes.items():
        if compare and name not in PEERS and not verdict(problem, outcome).startswith(("listed", "not")):
            outcome.refined = refine(problem, outcome)
    return outcomes


def verdict(problem: Problem, outcome: Outcome) -> str:
    """How the cost found compares with the known optima."""
    if not outcome.good:
        return "not solved"
    relative = [(outcome.cost - known) / known for known in problem.optima]
    if abs(relative[0]) < SAME:
        return "listed"
    if min(map(abs, relative)) < SAME:
        return "listed alternative"
    return "lower" if relative[0] < 0.0 else f"other, {100.0 * relative[0]:+.2g} %"


def stays(outcome: Outcome) -> str:
    """Whether IPOPT stays at an answer that is in no list."""
    if np.isnan(outcome.refined):
        return "-"
    if np.isinf(outcome.refined):
        return "fails"
    same = abs(outcome.refined - outcome.cost) <= STAYS * abs(outcome.cost)
    return "stays" if same else f"goes to {outcome.refined:.5f}"


def solved(problem: Problem, outcome: Outcome) -> bool:
    """Whether the answer is a known optimum to 1e-4, or one at which IPOPT stays."""
    known = min(abs(outcome.cost - known) / known for known in problem.optima) < 1e-4
    return outcome.good and (known or stays(outcome) == "stays")


def ratio(outcomes: dict[str, Outcome], name: str, peer: str) -> float:
    """Time over that of a peer; not a number where there is none or it did not converge."""
    if peer not in outcomes or name in PEERS or outcomes[peer].status != "converged":
        return np.nan
    return outcomes[name].median / outcomes[peer].median


def render(results: dict[Problem, dict[str, Outcome]], loops: str, rounds: int) -> str:
    """The results as Markdown."""
    head = (
        "problem", "solver", "status", "optimum", "IPOPT from there", "KKT", "cost", "listed", "iterations", "ms",
        *(f"times {peer}" for peer in PEERS), "OSQP QPs", "fallback QPs", "elastic QPs",
    )  # fmt: skip
    lines = []
    for problem, outcomes in results.items():
        for name, outcome in outcomes.items():
            counts = [str(outcome.routes.get(route, 0)) for route in ("osqp", "piqp", "elastic")]
            lines.append(
                (
                    problem.name, name, outcome.status, verdict(problem, outcome), stays(outcome),
                    "-" if np.isnan(outcome.kkt) else f"{outcome.kkt:.0e}", f"{outcome.cost:.5f}",
                    f"{problem.optima[0]:.5f}", str(outcome.iterations), f"{outcome.median:.1f}",
                    *(_number(ratio(outcomes, name, peer)) for peer in PEERS),
                    *(counts if name.startswith("sqp") else "---"),
                )
            )  # fmt: skip
    packages = ("unifg", "numpy", "scipy", "osqp", "piqp")
    peer_package = ("casadi",) if any("ipopt" in outcomes for outcomes in results.values()) else ()
    notes = (
        f"Median processor time of {rounds} interleaved cold solves (one where it took more than {SLOW / 1e3:.0f} s), "
        f"tolerance 1e-6 each. KKT: largest number of our own test, scaled as in unifg.answers.optimality. Solved: KKT "
        f"below {GOOD:.0e} (peers: converged), and a cost within 1e-4 of a known optimum or one at which IPOPT stays, "
        f"to {STAYS:.0e}, when it "
        "is started there at tolerance 1e-9; IPOPT is asked wherever the cost is not a known one to 1e-5. Staying "
        "shows a KKT point, not that it is a minimum. QPs: accepted iterations by the route that solved their "
        "subproblem. Times: ours over the peer's, where the peer converged. "
        f"{machine(*packages, *peer_package)}"
    )
    return "\n\n".join([_summary(results), table(head, lines, text=5), notes, loops])


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _summary(results: dict[Problem, dict[str, Outcome]]) -> str:
    names = dict.fromkeys(name for outcomes in results.values() for name in outcomes)
    lines = []
    for name in names:
        mine = {problem: outcomes[name] for problem, outcomes in results.items()}
        times = np.array([outcome.median for outcome in mine.values()])
        means = []
        for peer in PEERS:
            ratios = np.array([ratio(outcomes, name, peer) for outcomes in results.values()])
            ratios = ratios[~np.isnan(ratios)]
            means.append(float(np.exp(np.mean(np.log(ratios)))) if len(ratios) else np.nan)
        lines.append(
            (
                name,
                f"{sum(outcome.status == 'converged' for outcome in mine.values())} / {len(mine)}",
                f"{sum(solved(problem, outcome) for problem, outcome in mine.items())} / {len(mine)}",
                f"{sum(verdict(problem, outcome) == 'listed' for problem, outcome in mine.items())} / {len(mine)}",
                f"{np.median(times):.1f}",
                f"{times.max():.1f}",
                *map(_number, means),
            )
        )
    columns = (f"times {peer} (geometric mean)" for peer in PEERS)
    head = ("solver", "converged", "solved", "listed optimum", "median [ms]", "slowest [ms]", *columns)
    return table(head, lines)


def drive() -> str:
    """The closed loops as Markdown."""
    cases = itertools.product(("straight", "behind"), (False, True), (50,))
    return closed_loop.render({problem: closed_loop.drive(problem) for problem in itertools.starmap(Problem, cases)})


def main(arguments: list[str] | None = None) -> int:
    """Solve everything and write the tables; 0 only if our backends converge everywhere."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reference_problems", description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="solves of every problem by every solver")
    options = parser.parse_args(arguments)
    if find_spec("casadi") is None:
        print("casadi is not installed: no comparison with IPOPT and fatrop.")
    for problem in problems()[::3]:  # with and without discs: what is compiled is compiled before any clock runs
        measure(problem, 1)
    results = {problem: measure(problem, options.rounds) for problem in tqdm(problems(), unit="problem")}
    text = render(results, drive(), options.rounds)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "reference-problems.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    put_results(CHECKOUT / "docs" / "reference-problems.md", "Reference problems", text)
    ours = [outcomes[name] for outcomes in results.values() for name in ("ipm", "alm", "sqp")]
    return 0 if all(outcome.status == "converged" for outcome in ours) else 1


if __name__ == "__main__":
    raise SystemExit(main())
