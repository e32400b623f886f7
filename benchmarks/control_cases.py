"""Twenty-four optimal control problems, cold, in closed loop and from random starts, next to IPOPT and fatrop.

    python -m benchmarks.control_cases [--rounds R] [--starts S] [--quick]

The problems are stated in :mod:`benchmarks.control_problems`. With casadi installed, its IPOPT (MUMPS) and fatrop solve
them in turn with ours, both with exact Hessians and the same tolerance. Writes docs/control-cases.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks import compiled_peers, control_loops, control_pieces, control_starts
from benchmarks.control_problems import Problem, problems
from benchmarks.report import CHECKOUT, OUT, machine, put_results, table
from unifg.solvers.names import backends

TOLERANCE = 1e-4
SAME = 1e-4  # relative difference below which two costs are one optimum
SLOW = 300.0  # [ms]; a slower solve is not repeated
PEERS = ("ipopt", "fatrop", "fatrop, compiled")
"""The last one with its functions in machine code, the others in the virtual machine of casadi."""
SOLVERS = backends("ipm", "sqp", "alm", tolerance=TOLERANCE)


@dataclass
class Outcome:
    """What one solver made of one case.

    Attributes:
        status: in words.
        iterations: of the solver.
        cost: with its 1/2.
        times: one per round [ms].
    """

    status: str = ""
    iterations: int = 0
    cost: float = np.nan
    times: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))

    def verdict(self, problem: Problem) -> str:
        """How the cost compares with the known optima."""
        if self.status != "converged":
            return self.status
        relative = [self.cost / known - 1.0 for known in problem.optima]
        if abs(relative[0]) < SAME:
            return "listed"
        if min(map(abs, relative)) < SAME:
            return "listed alternative"
        return f"lower, {100.0 * relative[0]:+.2g} %" if relative[0] < 0.0 else f"other, {100.0 * relative[0]:+.2g} %"


def attempt(solver: fg.Solver, problem: Problem) -> Callable[[Outcome], None]:
    """A cold solve by one of ours: graph compiled and workspaces allocated before."""
    stated = problem.formulation()
    run = solver.prepare(stated.graph)

    def solve(outcome: Outcome) -> None:
        begin = time.thread_time()
        solution = run.solve(stated.guess)
        outcome.times.append(1e3 * (time.thread_time() - begin))
        outcome.status = solution.status.name.lower().replace("_", " ")
        outcome.iterations, outcome.cost = solution.iterations, solution.cost

    return solve


def attempt_peer(problem: Problem, name: str) -> Callable[[Outcome], None]:
    """A cold solve through casadi: expressions built, differentiated and, if so named, compiled before."""
    from benchmarks.control_peers import peer

    plugin, _, compiled = name.partition(", ")
    solver = peer(problem, plugin, compiled=bool(compiled), tol=TOLERANCE)
    guess = problem.guess()

    def solve(outcome: Outcome) -> None:
        outcome.times.append(solver.solve(*guess))
        outcome.status, outcome.iterations, outcome.cost = solver.status, solver.iterations, solver.cost

    return solve


def runnable() -> tuple[str, ...]:
    """Those this machine can run."""
    return PEERS if compiled_peers.COMPILER else PEERS[:-1]


def measure(problem: Problem, rounds: int) -> dict[str, Outcome]:
    """Solve a problem with every solver in turn, ``rounds`` times after one that is not counted."""
    attempts = {name: attempt(solver, problem) for name, solver in SOLVERS.items()}
    if find_spec("casadi") is not None:
        attempts |= {name: attempt_peer(problem, name) for name in runnable()}
    outcomes = {name: Outcome() for name in attempts}
    for solve in attempts.values():
        solve(Outcome())
    for _ in range(rounds):
        for name, solve in attempts.items():
            if max(outcomes[name].times, default=0.0) < SLOW:
                solve(outcomes[name])
    return outcomes


def render(results: dict[Problem, dict[str, Outcome]], rounds: int) -> str:
    """The cold solves as Markdown."""
    names = list(dict.fromkeys(name for outcomes in results.values() for name in outcomes))
    peers = [name for name in PEERS if name in names]
    head = ("case", "solver", "optimum", "cost", "listed", "iterations", "ms", *(f"times {peer}" for peer in peers))
    lines = []
    ratios: dict[tuple[str, str], list[float]] = {}
    for problem, outcomes in results.items():
        for name, outcome in outcomes.items():
            own = []
            for peer in peers:
                value = outcome.median / outcomes[peer].median
                counts = outcome.status == outcomes[peer].status == "converged" and name not in (peer, *PEERS[:-1])
                if counts:
                    ratios.setdefault((name, peer), []).append(value)
                own.append(f"{value:.2f}" if counts else "-")
            lines.append(
                (
                    f"{problem.robot} {problem.name}", name, outcome.verdict(problem), f"{outcome.cost:.5f}",
                    f"{problem.optima[0]:.5f}", str(outcome.iterations), f"{outcome.median:.3f}", *own,
                )
            )  # fmt: skip
    short = []
    for name in names:
        mine = {problem: outcomes[name] for problem, outcomes in results.items()}
        means = [
            f"{np.exp(np.mean(np.log(ratios[name, peer]))):.2f}" if (name, peer) in ratios else "-" for peer in peers
        ]
        short.append(
            (
                name,
                f"{sum(o.status == 'converged' for o in mine.values())} / {len(mine)}",
                f"{sum(o.verdict(p).startswith(('listed', 'lower')) for p, o in mine.items())} / {len(mine)}",
                str(sum(o.iterations for o in mine.values())),
                *means,
            )
        )
    summary = table(
        ("solver", "converged", "listed optimum or lower", "iterations in all",
         *(f"times {peer} (geometric mean)" for peer in peers)), short,
    )  # fmt: skip
    notes = (
        f"Cold: from the listed guess, tolerance {TOLERANCE:.0e} of every solver, median processor time of {rounds} "
        f"interleaved solves (one where it took more than {SLOW:.0f} ms). The cost of an interior point is above the "
        "optimum by about the tolerance times the number of active limits; listed optima were found at 1e-9. Same "
        f"optimum: within {SAME:.0e}. Our residuals are shipped kernels, which bring their derivatives; fatrop runs in "
        f"casadi's virtual machine and compiled ({compiled_peers.described()}), IPOPT in the virtual machine. "
        f"{machine('numpy', 'numba', *(('casadi',) if peers else ()))}"
    )
    return "\n\n".join([summary, table(head, lines, text=3), notes])


def main(arguments: list[str] | None = None) -> int:
    """Measure everything and write the tables; 0 only if the interior point solves every case and every start."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.control_cases", description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=20, help="cold solves of every case by every solver")
    parser.add_argument("--starts", type=int, default=control_starts.STARTS, help="random starts of every case")
    parser.add_argument("--quick", action="store_true", help="only print the cold solves")
    options = parser.parse_args(arguments)
    if find_spec("casadi") is None:
        print("casadi is not installed: no comparison with IPOPT and fatrop.")
    cold = {problem: measure(problem, options.rounds) for problem in tqdm(problems(), unit="case")}
    text = render(cold, options.rounds)
    if options.quick:
        print(text)
        return 0
    loops = {problem: control_loops.drive(problem) for problem in tqdm(control_loops.cases(), unit="loop")}
    random = {
        problem: control_starts.measure(problem, options.starts)
        for problem in tqdm(control_starts.blocked(), unit="case")
    }
    parts = [text, control_loops.render_single(loops), control_loops.render(loops), control_pieces.render()]
    parts.append(control_starts.render(random, options.starts))
    text = "\n\n".join(parts)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "control-cases.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    put_results(CHECKOUT / "docs" / "control-cases.md", "Control cases", text)
    ours = [outcomes["ipm"].status for outcomes in cold.values()]
    ours += [status for tallies in random.values() for status in tallies["ipm"].statuses]
    return 0 if set(ours) == {"converged"} else 1


if __name__ == "__main__":
    raise SystemExit(main())
