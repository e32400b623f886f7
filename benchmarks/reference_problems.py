"""Sixteen optimal control problems of a unicycle with known optima, solved cold by the constrained backends.

    python -m benchmarks.reference_problems [--rounds R] [--quick]

The problems are those of tests/problems/control.py with horizons of 20 and 50. If casadi is installed, its IPOPT
(MUMPS) and fatrop, both with exact Hessians, solve the same problems in turn with ours, for the times, and IPOPT starts
from every answer of ours that is in no list, to see whether it is an optimum. The same solvers then drive the robot for
a hundred steps (:mod:`benchmarks.control_loops`). Writes docs/reference-problems.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import cold, control_loops
from benchmarks.casadi_peer import available
from benchmarks.cold import Outcome, Results, Rules, Told
from benchmarks.report import command, machine, publish
from problems.control import Unicycle, sixteen
from unifg.solvers import SQP
from unifg.solvers.names import backends

STAYS = 1e-6  # relative difference of costs below which IPOPT has stayed where it was started
KNOWN = 1e-4  # and below which a cost counts as solved
PEERS = ("ipopt", "fatrop")
RULES = Rules(tolerance=1e-6, same=1e-5, good=1e-4, slow=2000.0, prepared=False, peers=PEERS)
ALONE = "sqp, OSQP alone"  # needs no success for the exit code: it shows what the fallback is for


def refine(outcome: Outcome) -> str:
    """Whether IPOPT stays at an answer that is in no list."""
    if not available() or not outcome.good(RULES) or outcome.verdict(RULES).startswith("listed"):
        return "-"
    from benchmarks.control_peers import ControlPeer

    # Its barrier begins small, or it would leave any answer at a limit.
    near: dict[str, Any] = {"bound_push": 1e-9, "bound_frac": 1e-9, "slack_bound_push": 1e-9, "slack_bound_frac": 1e-9}
    peer = ControlPeer(outcome.problem, "ipopt", **near, mu_init=1e-8, tol=1e-9)
    states = outcome.states.copy()
    states[:, 2] = np.unwrap(states[:, 2])
    peer.solve(states, outcome.controls)
    if peer.status != "converged":
        return "fails"
    return "stays" if abs(peer.cost / outcome.cost - 1.0) <= STAYS else f"goes to {peer.cost:.5f}"


def render(results: Results, loops: str, rounds: int) -> str:
    """The results as Markdown."""

    def solved(outcome: Outcome) -> bool:
        known = min(abs(outcome.cost / optimum - 1.0) for optimum in outcome.problem.optima) < KNOWN
        return outcome.good(RULES) and (known or outcome.refined == "stays")

    def route(of: str) -> Told:
        return lambda outcome: str(outcome.routes[of]) if outcome.solver.startswith("sqp") else "---"

    counted: dict[str, Callable[[Outcome], bool]] = {
        "converged": lambda outcome: outcome.status == "converged",
        "solved": solved,
        "listed optimum": lambda outcome: outcome.verdict(RULES) == "listed",
    }
    more: dict[str, Told] = {
        "status": lambda outcome: outcome.status,
        "IPOPT from there": lambda outcome: outcome.refined,
        "KKT": lambda outcome: "-" if np.isnan(outcome.kkt) else f"{outcome.kkt:.0e}",
        "OSQP QPs": route("osqp"), "fallback QPs": route("piqp"), "elastic QPs": route("elastic"),
    }  # fmt: skip
    notes = (
        f"Median processor time of {rounds} interleaved cold solves (one where it took more than "
        f"{RULES.slow / 1e3:.0f} s), tolerance {RULES.tolerance:.0e} each. KKT: largest number of our own test, scaled "
        f"as in unifg.solution.optimality. Solved: KKT below {RULES.good:.0e} (peers: converged), and a cost within "
        f"{KNOWN:.0e} of a known optimum or one at which IPOPT stays, to {STAYS:.0e}, when it is started there at "
        f"tolerance 1e-9; IPOPT is asked wherever the cost is not a known one to {RULES.same:.0e}. Staying shows a KKT "
        "point, not that it is a minimum. QPs: accepted iterations by the route that solved their subproblem. Times: "
        "ours over the peer's, where both converged. "
        f"{machine('unifg', 'numpy', 'scipy', 'osqp', 'piqp', *(('casadi',) if available() else ()))}"
    )
    parts = [cold.summary(results, RULES, counted), cold.every(results, RULES, more), notes, loops]
    return "\n\n".join(part for part in parts if part)


def main(arguments: list[str] | None = None) -> int:
    """Solve everything and write the tables; 0 only if our backends converge everywhere."""
    parser = command(__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="solves of every problem by every solver")
    parser.add_argument("--quick", action="store_true", help="the cold solves alone, and no page")
    options = parser.parse_args(arguments)
    if not available():
        print("casadi is not installed: no comparison with IPOPT and fatrop.")
    ours = backends("ipm", "alm", "sqp")
    solvers = {**ours, ALONE: SQP(fallback=None, qp_iterations=4000)}
    results = {
        problem: cold.measure(problem, solvers, RULES, options.rounds) for problem in tqdm(sixteen(), unit="problem")
    }
    for outcomes in results.values():
        for name in solvers:
            outcomes[name].refined = refine(outcomes[name])
    loops = {}
    if not options.quick:
        cases = [Unicycle(instance, blocked, 50) for instance in ("straight", "behind") for blocked in (False, True)]
        loops = {case: control_loops.drive(case, tuple(ours), PEERS) for case in tqdm(cases, unit="loop")}
    text = render(results, control_loops.render(loops) if loops else "", options.rounds)
    publish("reference-problems", text, docs=not options.quick)
    return 0 if all(outcomes[name].status == "converged" for outcomes in results.values() for name in ours) else 1


if __name__ == "__main__":
    raise SystemExit(main())
