"""Twenty-four optimal control problems, cold, in closed loop and from random starts, next to IPOPT and fatrop.

    python -m benchmarks.control_cases [--rounds R] [--starts S] [--quick]

The problems are stated in tests/problems/control.py. With casadi installed, its IPOPT (MUMPS) and fatrop solve them in
turn with ours, both with exact Hessians and the same tolerance. Writes docs/control-cases.md.
"""

from __future__ import annotations

from collections.abc import Callable

from tqdm import tqdm

from benchmarks import cold, compiled_peers, control_loops, control_pieces, control_starts
from benchmarks.casadi_peer import available
from benchmarks.cold import PEERS, Outcome, Results, Rules
from benchmarks.report import command, machine, publish
from problems.control import blocked, problems
from unifg.solvers.names import backends

RULES = Rules(tolerance=1e-4, same=1e-4, good=0.0, slow=300.0, prepared=True, peers=PEERS)


def render(results: Results, rounds: int) -> str:
    """The cold solves as Markdown."""
    counted: dict[str, Callable[[Outcome], bool]] = {
        "converged": lambda outcome: outcome.status == "converged",
        "listed optimum or lower": lambda outcome: outcome.verdict(RULES).startswith(("listed", "lower")),
    }
    notes = (
        f"Cold: from the listed guess, tolerance {RULES.tolerance:.0e} of every solver, median processor time of "
        f"{rounds} interleaved solves (one where it took more than {RULES.slow:.0f} ms). The cost of an interior point "
        "is above the optimum by about the tolerance times the number of active limits; listed optima were found at "
        f"1e-9. Same optimum: within {RULES.same:.0e}. Our residuals are those that ship; "
        "fatrop runs in casadi's virtual machine and compiled "
        f"({compiled_peers.described()}), IPOPT in the virtual machine. "
        f"{machine('numpy', 'numba', *(('casadi',) if available() else ()))}"
    )
    return "\n\n".join([cold.summary(results, RULES, counted), cold.every(results, RULES, {}), notes])


def main(arguments: list[str] | None = None) -> int:
    """Measure everything and write the tables; 0 only if the interior point solves every case and every start."""
    parser = command(__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="cold solves of every case by every solver")
    parser.add_argument("--starts", type=int, default=control_starts.STARTS, help="random starts of every case")
    parser.add_argument("--quick", action="store_true", help="the cold solves alone, and no page")
    options = parser.parse_args(arguments)
    if not available():
        print("casadi is not installed: no comparison with IPOPT and fatrop.")
    solvers = backends("ipm", "sqp", "alm", tolerance=RULES.tolerance)
    results = {
        problem: cold.measure(problem, solvers, RULES, options.rounds) for problem in tqdm(problems(), unit="case")
    }
    parts = [render(results, options.rounds)]
    ours = [outcomes["ipm"].status for outcomes in results.values()]
    if not options.quick:
        loops = {problem: control_loops.drive(problem) for problem in tqdm(control_loops.cases(), unit="loop")}
        starts = {problem: control_starts.measure(problem, options.starts) for problem in tqdm(blocked(), unit="case")}
        ours += [status for tallies in starts.values() for status in tallies["ipm"].statuses]
        parts += [control_loops.render_single(loops), control_loops.render(loops), control_pieces.render()]
        parts += [control_starts.render(starts, options.starts)]
    publish("control-cases", "\n\n".join(parts), docs=not options.quick)
    return 0 if set(ours) == {"converged"} else 1


if __name__ == "__main__":
    raise SystemExit(main())
