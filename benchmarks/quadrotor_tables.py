"""Tables of the flights through corridors: success, paired differences, the mass, times."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.campaign import interval
from benchmarks.report import table
from unifg.typing import Array

Row = dict[str, Any]

MEDIAN_MS, P99_MS, LEAST_TICKS = 15.0, 40.0, 5000  # limits of a tick
SUCCEEDED = 0.95
MASS_ERROR, COVERED = 0.01, 0.9
EARLY = "5"  # [s]

# Name and how to read each measure from the metrics; None where a flight has none.
MEASURES: dict[str, Callable[[Row], float | None]] = {
    "position error, rms [mm]": lambda m: 1e3 * m["position_error_m"]["rms"],
    "velocity error, rms [mm/s]": lambda m: 1e3 * m["velocity_error_m_per_s"]["rms"],
    "attitude error, rms [mrad]": lambda m: 1e3 * m["attitude_error_rad"]["rms"],
    "mass error after 5 s [%]": lambda m: _percent(m["mass_error_relative_5s"]),
    "landmark error, rms [mm]": lambda m: None if m["landmark_error_m"] is None else 1e3 * m["landmark_error_m"]["rms"],
    "collisions": lambda m: float(m["collisions"]),
    "reached without collision [%]": lambda m: 100.0 * float(m["succeeded"]),
    "time to goal [s]": lambda m: m["time_to_goal_s"],
    "least clearance [mm]": lambda m: 1e3 * m["min_clearance_m"],
    "estimate + plan, median [ms]": lambda m: m["tick_ms"]["p50"],
}
VARIANTS = ("separate", "sequential", "joint")
BASE = "sequential"
HEADLINE = "ipm"


def render(rows: Sequence[Row]) -> str:
    """Markdown of everything that was flown."""
    flown = [row for row in rows if "metrics" in row]
    refused = len(rows) - len(flown)
    parts = [section(flown) for section in (goals, ticks, success, failures, couplings, mass, weights)]
    if refused:
        parts.append(f"Flights refused: {refused}.")
    return "\n\n".join(part for part in parts if part)


def goals(rows: Sequence[Row]) -> str:
    """What was asked for, and what came of it."""
    lines = []
    for (solver, coupling), whole in _timed(rows).items():
        median, p99, count = worst(whole)
        text = f"median {median:.1f} ms, p99 {p99:.1f} ms, {count} ticks, worst of {len(whole)}"
        wanted = f"median < {MEDIAN_MS:g} ms, p99 < {P99_MS:g} ms over {LEAST_TICKS} ticks"
        kept = median < MEDIAN_MS and p99 < P99_MS and count >= LEAST_TICKS
        lines.append([f"a tick, {solver}, {coupling}", wanted, text, _yes(kept)])
    for (study, solver, coupling), chosen in _groups(rows).items():
        if study != "clearance" or coupling == "separate":
            continue
        good = sum(bool(row["metrics"]["succeeded"]) for row in chosen)
        about, count = f"{solver}, {coupling}", len(chosen)
        wanted = f"{100 * SUCCEEDED:g} % reach the target without collision"
        lines.append([f"flights, {about}", wanted, f"{good} of {count}", _yes(good >= SUCCEEDED * count)])
        values = np.array([row["mass"][EARLY] for row in chosen if EARLY in row["mass"]]).reshape(-1, 2)
        if not len(values):
            continue
        error = float(np.median(np.abs(values[:, 0])))
        covered = float((np.abs(values[:, 0]) <= 2.0 * values[:, 1]).mean())
        text = f"{100 * error:.2f} %, {100 * covered:.0f} % of {len(values)}"
        wanted = f"median error < {100 * MASS_ERROR:g} % after 5 s, in 2 sigma in {100 * COVERED:g} %"
        lines.append([f"mass, {about}", wanted, text, _yes(error < MASS_ERROR and covered >= COVERED)])
    if not lines:
        return ""
    return f"### In short\n\n{table(['what', 'wanted', 'found', 'kept'], lines, 4)}"


def worst(runs: Sequence[Array]) -> tuple[float, float, int]:
    """Greatest median and 99th percentile of several runs [ms], and the least number of ticks."""
    median = max(float(np.median(run[0] + run[1])) for run in runs)
    p99 = max(float(np.percentile(run[0] + run[1], 99)) for run in runs)
    return median, p99, min(run.shape[1] for run in runs)


def _timed(rows: Sequence[Row]) -> dict[tuple[str, str], list[Array]]:
    """By solver and coupling the times (2, n) of estimate and plan of every run [ms]."""
    groups: dict[tuple[str, str], dict[int, list[Array]]] = {}
    for row in _of(rows, "timing"):
        runs = groups.setdefault((row["solver"], row["coupling"]), {})
        runs.setdefault(row["run"], []).append(np.array([row["estimate_ms"], row["plan_ms"]]))
    return {key: [np.concatenate(parts, axis=1) for parts in runs.values()] for key, runs in groups.items()}


def ticks(rows: Sequence[Row]) -> str:
    """Times of estimate and plan together, pooled over the ticks of a run."""
    lines = []
    for (solver, coupling), runs in _timed(rows).items():
        median, p99, count = worst(runs)
        slowest = max(runs, key=lambda run: float(np.percentile(run.sum(axis=0), 99)))
        estimate, plan = (f"{np.median(part):.1f} / {np.percentile(part, 99):.1f}" for part in slowest)
        greatest = max(float(run.sum(axis=0).max()) for run in runs)
        cells = [f"{len(runs)}", f"{count}", f"{median:.1f}", f"{p99:.1f}", f"{greatest:.1f}", estimate, plan]
        lines.append([solver, coupling, *cells])
    if not lines:
        return ""
    head = ["solver", "coupling", "runs", "ticks", "median [ms]", "p99", "max", "estimate", "plan"]
    return (
        "### Twenty times a second\n\nEstimate and plan together, wall clock, one flight at a time. Of several "
        "runs the worst counts. Estimate and plan alone: median / 99th percentile of the slowest run.\n\n"
        f"{table(head, lines, 2)}"
    )


def success(rows: Sequence[Row]) -> str:
    """Share of flights that reach the target without a collision, with Wilson's interval."""
    lines = []
    for words, chosen in _groups(rows).items():
        metrics = [row["metrics"] for row in chosen]
        good, count = sum(bool(m["succeeded"]) for m in metrics), len(metrics)
        low, high = wilson(good, count)
        times = [m["time_to_goal_s"] for m in metrics if m["time_to_goal_s"] is not None]
        lines.append(
            [
                *words,
                f"{good} of {count}",
                f"{100 * low:.0f} .. {100 * high:.0f}",
                f"{sum(m['collisions'] > 0 for m in metrics)}",
                f"{sum(not m['reached'] for m in metrics)}",
                f"{np.median(times):.1f}" if times else "-",
                f"{np.median([m['min_clearance_m'] for m in metrics]):.2f}",
            ]
        )
    if not lines:
        return ""
    head = [
        "study",
        "solver",
        "coupling",
        "succeeded",
        "95 % [%]",
        "collided",
        "not there",
        "time [s]",
        "clearance [m]",
    ]
    return f"### Does it arrive?\n\n{table(head, lines, 3)}"


def failures(rows: Sequence[Row]) -> str:
    """What went wrong with hard clearance, one by one."""
    lines = []
    for words, chosen in _groups(rows).items():
        if words[0].startswith("potential") or words[2] == "separate":
            continue
        for row in sorted(chosen, key=lambda r: int(r["seed"])):
            m, contact = row["metrics"], row["contact"]
            if m["succeeded"]:
                continue
            if contact is None:
                what = f"{m['target_distance_m']:.1f} m from the target after {m['duration_s']:.1f} s"
            else:
                x, y, z = contact["place"]
                what = (
                    f"touched at {contact['time_s']:.1f} s, ({x:.1f}, {y:.1f}, {z:.1f}); belief off by "
                    f"{100 * contact['position_error_m']:.0f} cm, {contact['emergency_before']} of 20 ticks before "
                    "flown without a new plan"
                )
            lines.append([*words, str(row["seed"]), what])
    if not lines:
        return ""
    head = ["study", "solver", "coupling", "seed", "what"]
    return f"Flights that failed, potential costs and the separate coupling left out:\n\n{table(head, lines, 5)}"


def couplings(rows: Sequence[Row]) -> str:
    """Means of each coupling and intervals of the paired differences to the sequential one."""
    parts = []
    for solver in dict.fromkeys(row["solver"] for row in _of(rows, "flights")):
        of = {v: {r["seed"]: r for r in _of(rows, "flights", solver=solver, coupling=v)} for v in VARIANTS}
        names = [v for v in VARIANTS if of[v]]
        if BASE not in names or len(names) < 2:
            continue
        lines = []
        for measure, read in MEASURES.items():
            line = [measure]
            for name in names:
                mine, base = paired(of[name], of[BASE], read)
                if not len(mine):
                    line.append("-")
                elif name == BASE:
                    line.append(f"{base.mean():.3g}")
                else:
                    low, high = interval(mine - base)
                    line.append(f"{mine.mean():.3g} ({low:+.2g} .. {high:+.2g}), n={len(mine)}")
            lines.append(line)
        count = min(len(of[name]) for name in names)
        parts.append(f"#### {solver}, {count} seeds\n\n{table(['mean per flight', *names], lines)}")
    if not parts:
        return ""
    intro = (
        "### What does sharing buy?\n\nSame corridor, mass, drag, wind, disturbances and sensor noise for all. In "
        "brackets the 95 % bootstrap interval of the mean paired difference to the sequential coupling, over the n "
        "seeds for which both have the number: a time to goal needs arrival."
    )
    return "\n\n".join([intro, *parts])


def mass(rows: Sequence[Row]) -> str:
    """How well the mass is known, and how well its sigma says so."""
    lines = []
    for (study, solver, coupling), chosen in _groups(rows).items():
        if study != "clearance" or coupling == "separate":
            continue
        marks = sorted({mark for row in chosen for mark in row["mass"]}, key=float)
        marks = marks if solver == HEADLINE else [mark for mark in marks if mark == EARLY]
        for mark in marks:
            values = np.array([row["mass"][mark] for row in chosen if mark in row["mass"]])
            errors, sigmas = np.abs(values[:, 0]), values[:, 1]
            covered = float((errors <= 2.0 * sigmas).mean())
            cells = [f"{100 * np.median(errors):.2f}", f"{100 * np.percentile(errors, 90):.2f}"]
            lines.append(
                [
                    solver,
                    coupling,
                    mark,
                    f"{len(values)}",
                    *cells,
                    f"{100 * np.median(sigmas):.2f}",
                    f"{100 * covered:.0f}",
                ]
            )
    if not lines:
        return ""
    head = ["solver", "coupling", "time [s]", "flights", "median error [%]", "90 % below", "sigma [%]", "covered [%]"]
    return (
        "### The mass, believed wrong by 5 % at the start\n\n"
        f"Wanted: a median error below {100 * MASS_ERROR:g} % after 5 s, and the truth within two sigmas in at least "
        f"{100 * COVERED:g} % of the flights.\n\n{table(head, lines, 2)}"
    )


def weights(rows: Sequence[Row]) -> str:
    """The joint graph under other weights of the control costs: what they do to the estimate."""
    chosen = _of(rows, "weights")
    names = ["position error, rms [mm]", "velocity error, rms [mm/s]", "attitude error, rms [mrad]"]
    names += ["mass error after 5 s [%]", "reached without collision [%]"]
    lines = []
    for weight in sorted({row["weight"] for row in chosen}):
        metrics = [row["metrics"] for row in chosen if row["weight"] == weight]
        cells = [[v for m in metrics if (v := MEASURES[name](m)) is not None] for name in names]
        lines.append([f"{weight:g}", f"{len(metrics)}", *(f"{np.mean(c):.3g}" if c else "-" for c in cells)])
    if not lines:
        return ""
    text = "### Do wishes bias the estimate?\n\nJoint coupling, all control costs times a weight."
    return f"{text}\n\n{table(['weight', 'flights', *names], lines)}"


def paired(mine: dict[int, Row], base: dict[int, Row], read: Callable[[Row], float | None]) -> tuple[Array, Array]:
    """Values of two variants for the seeds of which both have one."""
    seeds = sorted(set(mine) & set(base))
    both = [(read(mine[seed]["metrics"]), read(base[seed]["metrics"])) for seed in seeds]
    kept = [pair for pair in both if None not in pair]
    values = np.array(kept, dtype=np.float64).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def wilson(good: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    share, spread = good / count, z * z / count
    middle = (share + 0.5 * spread) / (1.0 + spread)
    half = z * math.sqrt(share * (1.0 - share) / count + 0.25 * spread / count) / (1.0 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def _groups(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Flights by study, solver and coupling, in words."""
    titles = {
        "flights": "clearance",
        "potential": "potential 1/d",
        "association": "unknown association",
        "movers": "2 movers",
    }
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if row["study"] in titles:
            groups.setdefault((titles[row["study"]], row["solver"], row["coupling"]), []).append(row)
    return groups


def _of(rows: Sequence[Row], study: str, **wanted: str) -> list[Row]:
    return [row for row in rows if row["study"] == study and all(row[k] == v for k, v in wanted.items())]


def _yes(kept: bool) -> str:
    return "yes" if kept else "no"


def _percent(value: float | None) -> float | None:
    return None if value is None else 100.0 * value
