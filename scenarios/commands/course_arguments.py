"""``unifg run quadrotor-obstacles``; apart from the scenario, whose imports help does not need."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from unifg.scenarios.commands.outcome import Outcome, Progress

if TYPE_CHECKING:
    from unifg.answers.history import Iteration

__all__ = ["AVOIDANCES", "DESCRIPTION", "GUESSES", "HESSIANS", "add_arguments", "run"]

DESCRIPTION = "A quadrotor's flight past three walls and a cylinder, optimised as a whole."
HESSIANS = ("exact", "gauss-newton")
AVOIDANCES = ("potential", "hard")
GUESSES = ("hover", "line", "way")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario's own options, but not ``--solver`` and ``--out``."""
    parser.add_argument("--hessian", choices=HESSIANS, help="of the Lagrangian (default: exact)")
    parser.add_argument(
        "--avoidance",
        choices=AVOIDANCES,
        default=AVOIDANCES[0],
        help="obstacles repel by a cost 1/d, or the hull must keep clear of them (default: %(default)s)",
    )
    parser.add_argument(
        "--guess",
        choices=GUESSES,
        help="stay at the start, fly straight through everything, or along a shortest way "
        "(default: hover; way for hard clearance)",
    )
    parser.add_argument(
        "--general",
        action="store_true",
        help="state 1/d as a general cost instead of as a square; not for alm",
    )
    parser.add_argument(
        "--seed", type=_seed, metavar="S", help="of a random layout (default: the layout of the documentation)"
    )


def run(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    """Optimise the flight that was asked for."""
    from unifg.answers.status import Status
    from unifg.scenarios import course as obstacles  # physics: not for --help
    from unifg.scenarios.commands import course_results as obstacles_results  # physics: not for --help

    settings = obstacles.CourseSettings(
        solver=chosen.solver,
        hessian=chosen.hessian,
        avoidance=chosen.avoidance,
        guess=chosen.guess,
        general=chosen.general,
        seed=chosen.seed,
    )

    def tell(row: Iteration) -> None:
        share = 1.0 - 0.95**row.number  # nobody knows how many iterations there will be
        progress(share, f"iteration {row.number}, cost {row.cost:.5g}, violation {row.violation:.1e}")

    course = obstacles.run_course(settings, progress=tell)
    progress(1.0, "solved")
    return Outcome(
        course.succeeded,
        course.solution.status is Status.INTERRUPTED,
        obstacles_results.summary(course),
        lambda folder: obstacles_results.write_results(folder, course),
    )


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)
