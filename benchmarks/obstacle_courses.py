"""Two hundred obstacle courses: ways past three walls and a cylinder, by backend, Hessian and guess.

Ta et al. 2014, section V-A, vary the positions of the obstacles: "the drone often manages to get to the target", and
sometimes ends in a local minimum. This is counted on the layouts of ``COURSE_SEEDS``, for every backend with the exact
and the Gauss-Newton Hessian, with their potential 1/d and with hard clearance, from three guesses: hovering at the
start, the straight line to the target, and a shortest way. Weights were chosen on ``TUNING_SEEDS``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.comparison import Key, Row, counted, middle, portion, where
from benchmarks.report import Columns, listing, table
from benchmarks.runner import Cell, Study
from unifg.scenarios.course import AVOIDANCES, HESSIANS, Avoidance, Start
from unifg.scenarios.papers.courses import Method, Outcome
from unifg.scenarios.papers.courses import attempted as outcome
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.scenarios.simulation.layouts import COURSE_SEEDS, Layout, obstacle_course

SAME = 1e-3  # relative difference of cost below which two minima are one
BACKENDS = tuple(product(("sqp", "ipm", "alm"), HESSIANS))
EVERYWHERE: Start = "hover"  # the guess from which all backends begin; the others are tried with exact Hessians
GUESSES: tuple[Start, ...] = ("hover", "line", "way")


METHODS = tuple(
    Method(avoidance, guess, *chosen)
    for avoidance, guess, chosen in product(AVOIDANCES, GUESSES, BACKENDS)
    if guess == EVERYWHERE or chosen[1] == "exact"
)


Results = dict[Method, list[Outcome]]


def attempted(seed: int, **method: Any) -> Row:
    """Outcome of a method, its fields, on a layout, as a row."""
    return vars(outcome(Method(**method), seed))


def results_of(rows: Sequence[Row]) -> Results:
    """Outcomes of every method, layout by layout."""
    names = [field.name for field in fields(Outcome)]
    return {
        method: [Outcome(*(row[name] for name in names)) for row in where(rows, **vars(method))] for method in METHODS
    }


def lowest(results: Results, avoidance: Avoidance) -> list[Outcome | None]:
    """For every layout the cheapest local minimum that any method found."""
    rows = [outcomes for method, outcomes in results.items() if method.avoidance == avoidance]
    return [
        min((o for o in column if o.minimum), key=lambda o: o.cost, default=None) for column in zip(*rows, strict=True)
    ]


def distinct(costs: Iterable[float]) -> int:
    """Number of costs that differ by more than rounding and tolerance."""
    ordered = sorted(costs)
    return sum(b > a * (1.0 + SAME) for a, b in pairwise(ordered)) + bool(ordered)


def rates(results: Results) -> str:
    """Success and its opposite, per method."""
    best = {avoidance: lowest(results, avoidance) for avoidance in AVOIDANCES}
    groups = {m.words: [*zip(some, best[m.avoidance], strict=True)] for m, some in results.items()}
    columns: Columns[list[tuple[Outcome, Outcome | None]]] = {
        "success": counted(lambda o, _: o.safe),
        "95 % interval": lambda some: portion(sum(o.safe for o, _ in some), len(some)).replace("..", "to"),
        "converged": counted(lambda o, _: o.converged),
        "minimum short of target": counted(lambda o, _: o.minimum and not o.safe and not o.arrived),
        "minimum through an obstacle": counted(lambda o, _: o.minimum and not o.safe and o.arrived),
        "cheapest found": counted(lambda o, b: o.minimum and b is not None and o.cost <= b.cost * (1.0 + SAME)),
        "iterations": lambda some: middle([o.iterations for o, _ in some]),
        "ms": lambda some: middle([o.milliseconds for o, _ in some]),
    }
    return listing(("avoidance", "guess", "backend"), groups, columns)


def endings(results: Results) -> str:
    """Endings of solves, per method."""
    counts = {method: Counter(o.status for o in outcomes) for method, outcomes in results.items()}
    names = [name for name, _ in sum(counts.values(), Counter()).most_common()]
    lines = [(*method.words, *(str(found[name] or "") for name in names)) for method, found in counts.items()]
    return table(("avoidance", "guess", "backend", *names), lines, text=3)


Pairs = list[tuple[Outcome, Outcome]]


def hessians(results: Results) -> str:
    """Exact against Gauss-Newton from the same guess, pair by pair."""

    def same(pairs: Pairs) -> Pairs:
        return [(e, g) for e, g in pairs if e.minimum and g.minimum and abs(e.cost - g.cost) <= SAME * abs(e.cost)]

    def middles(pairs: Pairs, name: str) -> str:
        return " : ".join(middle([getattr(pair[k], name) for pair in same(pairs)]) for k in range(2))

    groups: dict[Key, Pairs] = {}
    for avoidance, solver in product(AVOIDANCES, ("sqp", "ipm")):
        exact = Method(avoidance, EVERYWHERE, solver, "exact")
        rough = replace(exact, hessian="gauss-newton")
        groups[avoidance, solver] = list(zip(results[exact], results[rough], strict=True))
    columns: Columns[Pairs] = {
        "converged: exact only": counted(lambda e, g: e.converged and not g.converged),
        "Gauss-Newton only": counted(lambda e, g: g.converged and not e.converged),
        "same minimum": lambda pairs: f"{len(same(pairs))} of {sum(e.minimum and g.minimum for e, g in pairs)}",
        "iterations there, exact : GN": lambda pairs: middles(pairs, "iterations"),
        "ms there, exact : GN": lambda pairs: middles(pairs, "milliseconds"),
    }
    return listing(("avoidance", "solver"), groups, columns)


def duels(results: Results) -> str:
    """Success of two methods on the same layouts, and how likely a difference as large is by chance (McNemar)."""
    groups: dict[Key, tuple[int, int]] = {}
    for avoidance in AVOIDANCES:
        sqp, ipm = (Method(avoidance, EVERYWHERE, solver, "exact") for solver in ("sqp", "ipm"))
        rough = [replace(method, hessian="gauss-newton") for method in (sqp, ipm)]
        for duel in ((sqp, rough[0]), (ipm, rough[1]), (sqp, ipm), (sqp, replace(sqp, guess="line"))):
            pairs = [(a.safe, b.safe) for a, b in zip(*(results[method] for method in duel), strict=True)]
            first, second = (f"{method.guess}, {method.solver}, {method.hessian}" for method in duel)
            groups[avoidance, first, second] = pairs.count((True, False)), pairs.count((False, True))
    columns: Columns[tuple[int, int]] = {
        "only first": lambda only: str(only[0]),
        "only second": lambda only: str(only[1]),
        "p": lambda only: f"{binomtest(only[0], sum(only)).pvalue if sum(only) else 1.0:.3f}",
    }
    return listing(("avoidance", "first", "second"), groups, columns)


def minima(results: Results) -> str:
    """Numbers of local minima that all methods together found on a layout."""
    lines = []
    for avoidance in AVOIDANCES:
        columns = list(zip(*(some for method, some in results.items() if method.avoidance == avoidance), strict=True))
        counts = [distinct(o.cost for o in column if o.minimum) for column in columns]
        best = [b for b in lowest(results, avoidance) if b is not None]
        numbers = (
            *(counts.count(k) for k in range(1, 4)), sum(c > 3 for c in counts), max(counts),
            sum(any(o.safe for o in column) for column in columns),
            sum(not b.clear for b in best), sum(not b.arrived for b in best),
        )  # fmt: skip
        lines.append((avoidance, *map(str, numbers)))
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
            endings(results),
            "Iterations and times are medians, times are the processor's.",
        )
    )


def cells(seeds: Sequence[int]) -> list[Cell]:
    """Every layout by every method."""
    return [{**vars(method), "seed": seed} for seed in seeds for method in METHODS]


def tables(rows: list[Row]) -> str:
    """Tables of all rows."""
    return render(results_of(rows), [obstacle_course(seed) for seed in sorted({row["seed"] for row in rows})])


STUDY = Study(cells, attempted, tables, COURSE_SEEDS)
