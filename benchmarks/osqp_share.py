"""How much of SQP's work OSQP really does: subproblems it solves, by case and by scenario.

    python -m benchmarks.osqp_share [--quick]

Counted are the subproblems with inequalities of ``SQP()`` as it is by default. Those that OSQP was asked for and missed
within its limit went to PIQP, as did those it sat out after a miss; linearisations that contradict themselves went to
the elastic problem. Writes docs/osqp.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tqdm import tqdm

from benchmarks.report import command, listing, machine, publish
from counts import Count, counting
from problems.control import Problem, blocked, problems, sixteen
from unifg.scenarios.course import CourseSettings, run_course
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.manoeuvres import CASES, run_manoeuvre
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.solvers import SQP


def cases(quick: bool) -> dict[str, Callable[[], object]]:
    """Everything that is counted, by name."""
    found: dict[str, Callable[[], object]] = {}
    for unicycle in sixteen()[:: 8 if quick else 1]:
        found[f"reference problem: {unicycle.name}"] = _cold(unicycle, 1e-6)
    for problem in problems()[:: 12 if quick else 1]:
        found[f"control case: {problem.title}"] = _cold(problem, 1e-4)
    if quick:
        return found
    found["random starts of the control cases with obstacles, 5 each"] = _starts
    for name, course in CASES.items():
        found[f"scenario: manoeuvre {name}"] = lambda course=course: run_manoeuvre(course)  # type: ignore[misc]
    for avoidance in ("potential", "hard"):
        settings = CourseSettings(solver="sqp", avoidance=avoidance)
        found[f"scenario: quadrotor past a cylinder, {avoidance}"] = lambda settings=settings: run_course(settings)  # type: ignore[misc]
    for coupling in ("sequential", "joint"):
        drive = NavigationSettings(coupling=coupling, obstacles=4, seed=1)
        found[f"scenario: drive through a building, {coupling}"] = lambda drive=drive: run_navigation(drive)  # type: ignore[misc]
    flight = FlightSettings(solver="sqp")
    found["scenario: quadrotor flight, sequential"] = lambda: run_flight(flight)
    return found


def _cold(problem: Problem, tolerance: float) -> Callable[[], object]:
    """A solve of a problem from its guess."""
    stated = problem.formulation()
    return lambda: SQP(tolerance=tolerance).prepare(stated.graph).solve(stated.guess)


def _starts() -> None:
    """From five random guesses each."""
    for problem in blocked():
        stated = problem.formulation()
        run = SQP(tolerance=1e-4).prepare(stated.graph)
        for states, controls in problem.starts(5):
            run.solve({stated.x: states, stated.u: controls})


def render(counts: dict[str, Count]) -> str:
    """The table and what it says."""
    columns: dict[str, Callable[[Count], str]] = {
        "subproblems": lambda count: str(len(count.routes)),
        "OSQP solved": lambda count: f"{100.0 * count.share:.0f} %" if count.routes else "-",
        "its iterations": lambda count: f"{np.median(count.asked):.0f} of {count.limits[0]}" if count.asked else "-",
        "it missed": lambda count: str(len(count.asked) - count.by("osqp")),
        "PIQP solved": lambda count: str(count.by("piqp")),
        "elastic": lambda count: str(count.by("elastic")),
    }
    every = [route for count in counts.values() for route in count.routes]
    worst = sorted((count.share, name) for name, count in counts.items() if count.routes)[:3]
    losing = "; ".join(f"{name} ({100.0 * share:.0f} %)" for share, name in worst)
    return "\n\n".join(
        [
            f"OSQP solved {every.count('osqp')} of {len(every)} subproblems, "
            f"{100.0 * every.count('osqp') / max(len(every), 1):.0f} %. Least: {losing}.",
            listing(["what"], {(name,): count for name, count in counts.items()}, columns),
            "Its iterations: the median over all times it was asked, and its limit. The subproblems it missed are paid "
            "for twice.",
            machine("unifg", "osqp", "piqp"),
        ]
    )


def main(arguments: list[str] | None = None) -> int:
    """Count, and write the page."""
    parser = command(__doc__)
    parser.add_argument("--quick", action="store_true", help="four cases, and no page")
    chosen = parser.parse_args(arguments)
    counts = {}
    for name, run in tqdm(cases(chosen.quick).items(), unit="case"):
        with counting() as counts[name]:
            run()
    publish("osqp", render(counts), docs=not chosen.quick)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
