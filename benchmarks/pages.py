"""The pages with measured tables, and the module that measures each.

    python -m benchmarks.pages                      names the pages
    python -m benchmarks.pages measure PAGE ...     measures pages again, ``all`` for every one

``make results PAGE=...`` and ``make bench`` measure.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
DOCS = CHECKOUT / "docs"


@dataclass(frozen=True)
class Page:
    """One page of docs/ with measured tables.

    Attributes:
        name: of the file, without its ending.
        title: of the page.
        module: measures and writes it.
        arguments: given to the module.
        hours: about how long on two cores.
    """

    name: str
    title: str
    module: str
    arguments: tuple[str, ...] = ()
    hours: float = 0.1

    @property
    def path(self) -> Path:
        """The file."""
        return DOCS / f"{self.name}.md"


PAGES = {
    page.name: page
    for page in (
        Page("reference-problems", "Reference problems", "benchmarks.reference_problems"),
        Page("models", "Models", "benchmarks.obstacle_fields"),
        Page("quadrotor-obstacles", "Scenario: quadrotor-obstacles", "benchmarks.obstacle_courses", hours=0.25),
        Page("smoothing", "Smoothing while driving", "benchmarks.incremental"),
        Page("iterations", "Iterations", "benchmarks.iterations"),
        Page("osqp", "What OSQP solves", "benchmarks.osqp_share", hours=0.05),
        Page("choosing", "Choosing a solver, measured", "benchmarks.choosing", hours=0.08),
        Page("collection", "A collection of small problems", "benchmarks.collection"),
        Page("velocity-tracking", "Velocity tracking", "benchmarks.ecg2o"),
        Page("control-cases", "Control cases", "benchmarks.control_cases", hours=0.4),
        Page("own-functions", "Functions of one's own", "benchmarks.own_functions"),
        Page("claims", "What the backends claim, judged from outside", "benchmarks.claims", hours=0.2),
        Page("reliability", "Reliability", "benchmarks.faults", hours=0.3),
        Page("navigation", "Drives, sequential coupling", "benchmarks.navigation", hours=0.05),
        Page("joint-drives", "Drives, joint coupling", "benchmarks.navigation", ("--coupling", "joint"), hours=0.06),
        Page("experiments", "Experiments", "benchmarks.experiments", hours=3.0),
        Page("joint", "What the joint graph buys", "benchmarks.coupling", hours=0.8),
        Page("covariance-plans", "Covariance in the plan", "benchmarks.covariance_plans"),
        Page("active-perception", "Plans that go where they learn", "benchmarks.active_perception"),
        Page("potential-weights", "The weight of Ta's cost", "benchmarks.potential_weights"),
        Page("shared-dynamics", "Dynamics in the past, parameters in the plan", "benchmarks.shared_dynamics"),
        Page("excluded-pasts", "Pasts that cannot have been", "benchmarks.excluded_pasts", hours=0.05),
        Page("quadrotor-joint", "One graph that estimates and flies", "benchmarks.quadrotor_pull", hours=0.15),
        Page("quadrotor-mpc", "Scenario: quadrotor-mpc", "benchmarks.quadrotor_flights", hours=1.5),
        Page("barriers", "Control barrier functions", "benchmarks.guarded_flights", hours=0.15),
        Page("horizon-and-velocity", "What horizon and velocity buy", "benchmarks.horizon_and_velocity", hours=0.15),
        Page("localisation", "Localisation beside Monte Carlo", "benchmarks.localisation", hours=0.15),
        Page("avoidance", "Ways of avoiding things", "benchmarks.crossing", hours=0.25),
        Page("ipopt", "Beside IPOPT", "benchmarks.against_ipopt", hours=0.1),
        Page("safety", "Flight that must keep its distance", "benchmarks.safe_campaign", hours=0.6),
        Page("wrong-closures", "Wrong loop closures", "benchmarks.wrong_closures", hours=4.0),
        Page("endurance", "Long runs", "benchmarks.endurance", hours=0.9),
        Page("benchmarks", "Benchmarks", "benchmarks.elimination"),
    )
}


def measure(pages: list[Page]) -> int:
    """Measure pages one after the other; the worst exit code."""
    worst = 0
    for page in pages:
        print(f"docs/{page.name}.md by {page.module}, about {page.hours:g} h", flush=True)
        command = [sys.executable, "-m", page.module, *page.arguments]
        worst = max(worst, abs(subprocess.run(command, cwd=CHECKOUT, check=False).returncode))
    return worst


def main(arguments: list[str] | None = None) -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pages", description=__doc__.split("\n")[0])
    actions = parser.add_subparsers(dest="action")
    again = actions.add_parser("measure", help="measure pages again")
    again.add_argument("pages", nargs="+", choices=["all", *PAGES], metavar="PAGE", help=", ".join(PAGES))
    options = parser.parse_args(arguments)
    if options.action == "measure":
        return measure(list(PAGES.values()) if "all" in options.pages else [PAGES[name] for name in options.pages])
    for page in PAGES.values():
        print(f"{page.name:20} {page.module:30} about {page.hours:g} h")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
