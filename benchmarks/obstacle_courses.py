"""Two hundred obstacle courses: which backend finds a way past three walls and a cylinder, and where it gets stuck.

    python -m benchmarks.obstacle_courses [--layouts K] [--tuning] [--again]

Ta et al. 2014, section V-A, vary the positions of the obstacles: "the drone often manages to get to the target", and
sometimes ends in a local minimum. Here this is counted, on the layouts of ``COURSE_SEEDS``, for every backend with the
exact and the Gauss-Newton Hessian, with their potential 1/d and with hard clearance, from three guesses: hovering at
the start, the straight line to the target, and a shortest way. Weights were chosen on ``TUNING_SEEDS``
(``--tuning`` runs these, and writes no page). Writes docs/quadrotor-obstacles.md.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from benchmarks.report import CHECKOUT, OUT, machine, put_results, table
from benchmarks.timing import pin
from unifg.scenarios.course import (
    AVOIDANCES,
    HESSIANS,
    Avoidance,
    Course,
    CourseSettings,
    Hessian,
    Start,
    backend,
    course_guess,
    state_problem,
)
from unifg.scenarios.worlds.air import VEHICLE_RADIUS
from unifg.scenarios.worlds.layouts import COURSE_SEEDS, TUNING_SEEDS, Layout, obstacle_course

SAME = 1e-3  # relative difference of cost below which two minima are one
BACKENDS = tuple(product(("sqp", "ipm", "alm"), HESSIANS))
EVERYWHERE: Start = "hover"  # the guess from which all backends begin; the others are tried with exact Hessians
GUESSES: tuple[Start, ...] = ("hover", "line", "way")


@dataclass(frozen=True)
class Method:
    """One way to solve a layout."""

    avoidance: Avoidance
    guess: Start
    solver: str
    hessian: Hessian

    @property
    def settings(self) -> CourseSettings:
        """The numbers of the scenario, unchanged."""
        return CourseSettings(avoidance=self.avoidance, guess=self.guess, solver=self.solver, hessian=self.hessian)

    @property
    def words(self) -> tuple[str, str, str]:
        """For tables."""
        return self.avoidance, self.guess, f"{self.solver}, {self.hessian}"


METHODS = tuple(
    Method(avoidance, guess, *chosen)
    for avoidance, guess, chosen in product(AVOIDANCES, GUESSES, BACKENDS)
    if guess == EVERYWHERE or chosen[1] == "exact"
)


@dataclass(frozen=True)
class Outcome:
    """What became of one layout.

    Attributes:
        seed: of the layout.
        status: of the solver.
        converged: whether the KKT test passed.
        arrived: whether the end is near the target.
        clear: whether nothing is touched, at nodes and between them.
        flyable: whether states follow from controls within the limits.
        cost: the objective.
        distance: from the end to the target [m].
        clearance: least one of the hull on the way [m].
        iterations: of the solver.
        milliseconds: of the processor, for the solve.
    """

    seed: int
    status: str
    converged: bool
    arrived: bool
    clear: bool
    flyable: bool
    cost: float
    distance: float
    clearance: float
    iterations: int
    milliseconds: float

    @property
    def safe(self) -> bool:
        """Whether it can be flown to the target without a collision, optimal or not."""
        return self.arrived and self.clear and self.flyable

    @property
    def minimum(self) -> bool:
        """Whether it is a local minimum of the problem."""
        return self.converged and self.flyable


Results = dict[Method, list[Outcome]]


def attempt(method: Method, layout: Layout, seed: int) -> Outcome:
    """Solve one layout cold; the processor's time is counted, without that of building the graph."""
    settings = method.settings
    graph, x, u = state_problem(settings, layout)
    run = backend(settings).prepare(graph)
    states, controls = course_guess(settings, layout)
    begin = time.process_time()
    solution = run.solve({x: states, u: controls})
    elapsed = time.process_time() - begin
    course = Course(settings, layout, solution, solution[x], solution[u], iterates=np.zeros((0, *states.shape)))
    return Outcome(
        seed,
        solution.status.name.lower().replace("_", " "),
        solution.converged,
        course.arrived,
        course.clear,
        course.flyable,
        float(solution.cost),
        course.target_distance,
        course.clearance_between,
        solution.iterations,
        1e3 * elapsed,
    )


def wilson(hits: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """Confidence interval of a rate (Wilson 1927), 95 % by default."""
    if of == 0:
        return 0.0, 1.0
    rate, share = hits / of, z * z / of
    middle = (rate + 0.5 * share) / (1.0 + share)
    half = z * math.sqrt(rate * (1.0 - rate) / of + 0.25 * share / of) / (1.0 + share)
    return max(0.0, middle - half), min(1.0, middle + half)


def lowest(results: Results, avoidance: Avoidance) -> list[Outcome | None]:
    """For every layout the cheapest local minimum that any method found."""
    rows = [outcomes for method, outcomes in results.items() if method.avoidance == avoidance]
    return [
        min((o for o in column if o.minimum), key=lambda o: o.cost, default=None) for column in zip(*rows, strict=True)
    ]


def distinct(costs: Iterable[float]) -> int:
    """How many costs there are that differ by more than rounding and tolerance."""
    ordered = sorted(costs)
    return sum(b > a * (1.0 + SAME) for a, b in pairwise(ordered)) + bool(ordered)


def rates(results: Results) -> str:
    """Success and its opposite, per method."""
    best = {avoidance: lowest(results, avoidance) for avoidance in AVOIDANCES}
    lines = []
    for method, outcomes in results.items():
        safe, count = sum(o.safe for o in outcomes), len(outcomes)
        low, high = wilson(safe, count)
        stuck = [o for o in outcomes if o.minimum and not o.safe]
        found = sum(
            o.minimum and b is not None and o.cost <= b.cost * (1.0 + SAME)
            for o, b in zip(outcomes, best[method.avoidance], strict=True)
        )
        lines.append(
            (
                *method.words, str(safe), f"{100 * low:.0f} to {100 * high:.0f} %",
                str(sum(o.converged for o in outcomes)), str(sum(not o.arrived for o in stuck)),
                str(sum(o.arrived for o in stuck)), str(found),
                _middle([o.iterations for o in outcomes]), _middle([o.milliseconds for o in outcomes]),
            )
        )  # fmt: skip
    head = (
        "avoidance", "guess", "backend", "success", "95 % interval", "converged", "minimum short of target",
        "minimum through an obstacle", "cheapest found", "iterations", "ms",
    )  # fmt: skip
    return table(head, lines, text=3)


def words(results: Results) -> str:
    """How solves ended, per method."""
    names = [name for name, _ in Counter(o.status for outcomes in results.values() for o in outcomes).most_common()]
    lines = []
    for method, outcomes in results.items():
        counts = Counter(o.status for o in outcomes)
        lines.append((*method.words, *(str(counts[name] or "") for name in names)))
    return table(("avoidance", "guess", "backend", *names), lines, text=3)


def hessians(results: Results) -> str:
    """Exact against Gauss-Newton from the same guess, pair by pair."""
    lines = []
    for avoidance, solver in product(AVOIDANCES, ("sqp", "ipm")):
        exact, rough = (results[Method(avoidance, EVERYWHERE, solver, h)] for h in ("exact", "gauss-newton"))
        pairs = list(zip(exact, rough, strict=True))
        same = [(e, g) for e, g in pairs if e.minimum and g.minimum and abs(e.cost - g.cost) <= SAME * abs(e.cost)]
        both = sum(e.minimum and g.minimum for e, g in pairs)
        lines.append(
            (
                avoidance, solver, str(sum(e.converged and not g.converged for e, g in pairs)),
                str(sum(g.converged and not e.converged for e, g in pairs)),
                f"{len(same)} of {both}",
                f"{_middle([e.iterations for e, _ in same])} : {_middle([g.iterations for _, g in same])}",
                f"{_middle([e.milliseconds for e, _ in same])} : {_middle([g.milliseconds for _, g in same])}",
            )
        )  # fmt: skip
    head = (
        "avoidance", "solver", "converged: exact only", "Gauss-Newton only", "same minimum",
        "iterations there, exact : GN", "ms there, exact : GN",
    )  # fmt: skip
    return table(head, lines, text=2)


def duels(results: Results) -> str:
    """Success of two methods on the same layouts, and how likely a difference as large is by chance (McNemar)."""
    lines = []
    for avoidance in AVOIDANCES:
        sqp, ipm, line = (
            Method(avoidance, EVERYWHERE, "sqp", "exact"),
            Method(avoidance, EVERYWHERE, "ipm", "exact"),
            Method(avoidance, "line", "sqp", "exact"),
        )
        rough = [replace(method, hessian="gauss-newton") for method in (sqp, ipm)]
        for first, second in ((sqp, rough[0]), (ipm, rough[1]), (sqp, ipm), (sqp, line)):
            pairs = [(a.safe, b.safe) for a, b in zip(results[first], results[second], strict=True)]
            only = pairs.count((True, False)), pairs.count((False, True))
            chance = binomtest(only[0], sum(only)).pvalue if sum(only) else 1.0
            words = [f"{method.guess}, {method.solver}, {method.hessian}" for method in (first, second)]
            lines.append((avoidance, *words, str(only[0]), str(only[1]), f"{chance:.3f}"))
    return table(("avoidance", "first", "second", "only first", "only second", "p"), lines, text=3)


def minima(results: Results) -> str:
    """How many local minima all methods together found on each layout."""
    lines = []
    for avoidance in AVOIDANCES:
        rows = [outcomes for method, outcomes in results.items() if method.avoidance == avoidance]
        columns = list(zip(*rows, strict=True))
        counts = [distinct(o.cost for o in column if o.minimum) for column in columns]
        best = lowest(results, avoidance)
        lines.append(
            (
                avoidance, *(str(sum(c == k for c in counts)) for k in range(1, 4)), str(sum(c > 3 for c in counts)),
                str(max(counts)), str(sum(any(o.safe for o in column) for column in columns)),
                str(sum(b is not None and not b.clear for b in best)),
                str(sum(b is not None and not b.arrived for b in best)),
            )
        )  # fmt: skip
    head = (
        "avoidance", "layouts with 1 minimum", "2", "3", "more", "most", "success by any method",
        "cheapest hits something", "cheapest stops short",
    )  # fmt: skip
    return table(head, lines)


def render(results: Results, layouts: Sequence[Layout]) -> str:
    """All tables as Markdown."""
    count = len(layouts)
    ways = np.array([layout.widest_way() for layout in layouts])
    line = np.linspace(0.0, 1.0, 500)[:, None]
    straight = sum(
        bool((layout.distance(layout.start[:2] + line * (layout.target - layout.start)[:2]) > VEHICLE_RADIUS).all())
        for layout in layouts
    )
    facts = (
        f"{count} layouts. A way for the hull (radius {VEHICLE_RADIUS:g} m) exists in "
        f"{int((ways > VEHICLE_RADIUS).sum())}: the widest has a clearance of {ways.min():.2f} m at least, "
        f"{np.median(ways):.2f} m in the median. The straight line is free in {straight}."
    )
    return "\n\n".join(
        (
            facts,
            rates(results),
            "Exact against Gauss-Newton, from hovering, layout by layout:",
            hessians(results),
            "Success of two methods on the same layouts (p by McNemar's exact test):",
            duels(results),
            "Local minima that all methods together found (costs apart by more than 0.1 %):",
            minima(results),
            "How solves ended:",
            words(results),
            "Iterations and times are medians, times are the processor's. `python -m benchmarks.obstacle_courses`. "
            + machine("numpy", "scipy", "osqp", "piqp"),
        )
    )


def measured(seeds: Sequence[int], layouts: Sequence[Layout]) -> Results:
    """Solve every layout by every method."""
    for method in METHODS:  # compiles
        attempt(method, obstacle_course(), -1)
    results: Results = {method: [] for method in METHODS}
    for seed, layout in tqdm(list(zip(seeds, layouts, strict=True)), unit="layout"):
        for method in METHODS:
            results[method].append(attempt(method, layout, seed))
    return results


def recorded(path: Path) -> Results:
    """What an earlier run has written."""
    results: Results = {}
    for entry in json.loads(path.read_text(encoding="utf-8")):
        outcomes = [Outcome(**outcome) for outcome in entry.pop("outcomes")]
        results[Method(**entry)] = outcomes
    return results


def _middle(values: Sequence[float]) -> str:
    return f"{np.median(values):.0f}" if values else "-"


def main(arguments: list[str] | None = None) -> int:
    """Solve every layout by every method and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.obstacle_courses", description=__doc__.split("\n")[0])
    parser.add_argument("--layouts", type=int, default=len(COURSE_SEEDS), help="number of layouts")
    parser.add_argument("--tuning", action="store_true", help="the layouts settings were chosen on; writes no page")
    parser.add_argument("--again", action="store_true", help="make tables of the outcomes recorded last")
    options = parser.parse_args(arguments)
    seeds = (TUNING_SEEDS if options.tuning else COURSE_SEEDS)[: options.layouts]
    if options.layouts < 1:
        parser.error(f"--layouts must be positive, found {options.layouts}")
    name = "obstacle-courses" + ("-tuning" if options.tuning else "")
    layouts = [obstacle_course(seed) for seed in seeds]
    if options.again:
        results = recorded(OUT / f"{name}.json")
        layouts = layouts[: len(results[METHODS[0]])]
    else:
        pin()
        results = measured(seeds, layouts)
        OUT.mkdir(parents=True, exist_ok=True)
        record = [{**asdict(method), "outcomes": [asdict(o) for o in outcomes]} for method, outcomes in results.items()]
        (OUT / f"{name}.json").write_text(json.dumps(record) + "\n", encoding="utf-8", newline="\n")
    text = render(results, layouts)
    print(text)
    (OUT / f"{name}.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    if not options.tuning:
        put_results(CHECKOUT / "docs" / "quadrotor-obstacles.md", "Scenario: quadrotor-obstacles", text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
