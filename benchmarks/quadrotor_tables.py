"""Tables of the flights through corridors: success, paired differences, the mass, times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.comparison import Key, Read, Row, comparison, grouped, metric, middle, portion, where
from benchmarks.report import Columns, listing, table
from unifg.typing import Array

MASS_ERROR, COVERED = 0.01, 0.9
EARLY = "5"  # [s]

MEASURES: dict[str, Read] = {
    "position error, rms [mm]": metric(1e3, "position_error_m", "rms"),
    "velocity error, rms [mm/s]": metric(1e3, "velocity_error_m_per_s", "rms"),
    "attitude error, rms [mrad]": metric(1e3, "attitude_error_rad", "rms"),
    "mass error after 5 s [%]": metric(1e2, "mass_error_relative_5s"),
    "landmark error, rms [mm]": metric(1e3, "landmark_error_m", "rms"),
    "collisions": metric(1.0, "collisions"),
    "reached without collision [%]": metric(100.0, "succeeded"),
    "time to goal [s]": metric(1.0, "time_to_goal_s"),
    "least clearance [mm]": metric(1e3, "min_clearance_m"),
    "estimate + plan, median [ms]": metric(1.0, "tick_ms", "p50"),
}
TITLES = {
    "flights": "clearance",
    "potential": "potential 1/d",
    "association": "unknown association",
    "movers": "2 movers",
}
VARIANTS = ("separate", "sequential", "joint")
BASE = "sequential"
HEADLINE = "ipm"


def render(rows: Sequence[Row]) -> str:
    """Markdown of everything that was flown."""
    flown = where(rows)
    parts = [section(flown) for section in (ticks, success, failures, couplings, mass)]
    if len(flown) < len(rows):
        parts.append(f"Flights refused: {len(rows) - len(flown)}.")
    return "\n\n".join(part for part in parts if part)


def worst(runs: Sequence[Array]) -> tuple[float, float, int]:
    """Greatest median and 99th percentile of several runs (2, n) [ms], and the least number of ticks."""
    median, p99 = np.max([np.percentile(run.sum(axis=0), [50.0, 99.0]) for run in runs], axis=0)
    return float(median), float(p99), min(run.shape[1] for run in runs)


def _timed(rows: Sequence[Row]) -> dict[Key, list[Array]]:
    """Times (2, n) of estimate and plan of every run [ms], by solver and coupling."""
    runs: dict[Key, list[Array]] = {}
    for (solver, coupling, _), flights in grouped(where(rows, study="timing"), "solver", "coupling", "run").items():
        parts = [np.array([row["estimate_ms"], row["plan_ms"]]) for row in flights]
        runs.setdefault((solver, coupling), []).append(np.concatenate(parts, axis=1))
    return runs


def ticks(rows: Sequence[Row]) -> str:
    """Times of estimate and plan together, pooled over the ticks of a run."""
    lines = []
    for (solver, coupling), runs in _timed(rows).items():
        median, p99, count = worst(runs)
        slowest = max(runs, key=lambda run: float(np.percentile(run.sum(axis=0), 99)))
        alone = (f"{np.median(part):.1f} / {np.percentile(part, 99):.1f}" for part in slowest)
        greatest = max(float(run.sum(axis=0).max()) for run in runs)
        numbers = (f"{value:.1f}" for value in (median, p99, greatest))
        lines.append([solver, coupling, str(len(runs)), str(count), *numbers, *alone])
    head = ["solver", "coupling", "runs", "ticks", "median [ms]", "p99", "max", "estimate", "plan"]
    text = (
        "### Twenty times a second\n\nEstimate and plan together, wall clock, one flight at a time. Of several "
        "runs the worst counts. Estimate and plan alone: median / 99th percentile of the slowest run."
    )
    return _section(text, head, lines, 2)


# What is told of the metrics of several flights.
SUCCESS: Columns[list[Row]] = {
    "succeeded": lambda flights: f"{_good(flights)} of {len(flights)}",
    "95 % [%]": lambda flights: portion(_good(flights), len(flights)).removesuffix(" %"),
    "collided": lambda flights: str(sum(m["collisions"] > 0 for m in flights)),
    "not there": lambda flights: str(sum(not m["reached"] for m in flights)),
    "time [s]": lambda flights: middle([m["time_to_goal_s"] for m in flights if m["time_to_goal_s"] is not None], 1),
    "clearance [m]": lambda flights: middle([m["min_clearance_m"] for m in flights], 2),
}


def success(rows: Sequence[Row]) -> str:
    """Share of flights that reach the target without a collision, with Wilson's interval."""
    groups = {names: [row["metrics"] for row in chosen] for names, chosen in _groups(rows).items()}
    return "### Does it arrive?\n\n" + listing(["study", "solver", "coupling"], groups, SUCCESS) if groups else ""


def _good(flights: list[Row]) -> int:
    return sum(bool(m["succeeded"]) for m in flights)


def failures(rows: Sequence[Row]) -> str:
    """Failures with hard clearance, one by one."""
    lines = []
    for words, chosen in _groups(rows).items():
        if words[0].startswith("potential") or words[2] == "separate":
            continue
        for row in sorted(chosen, key=lambda r: int(r["seed"])):
            if not row["metrics"]["succeeded"]:
                lines.append([*words, str(row["seed"]), _what(row)])
    text = "Flights that failed, potential costs and the separate coupling left out:"
    return _section(text, ["study", "solver", "coupling", "seed", "what"], lines, 5)


def _what(row: Row) -> str:
    m, contact = row["metrics"], row["contact"]
    if contact is None:
        return f"{m['target_distance_m']:.1f} m from the target after {m['duration_s']:.1f} s"
    x, y, z = contact["place"]
    return (
        f"touched at {contact['time_s']:.1f} s, ({x:.1f}, {y:.1f}, {z:.1f}); belief off by "
        f"{100 * contact['position_error_m']:.0f} cm, {contact['emergency_before']} of 20 ticks before "
        "flown without a new plan"
    )


def couplings(rows: Sequence[Row]) -> str:
    """Means of each coupling and intervals of the paired differences to the sequential one."""
    parts = [
        "### What does sharing buy?\n\nSame corridor, mass, drag, wind, disturbances and sensor noise for all. In "
        "brackets the 95 % bootstrap interval of the mean paired difference to the sequential coupling; where only n "
        "seeds have the number for both, n is told: a time to goal needs arrival."
    ]
    for solver in dict.fromkeys(row["solver"] for row in where(rows, study="flights")):
        of = {v: where(rows, study="flights", solver=solver, coupling=v) for v in VARIANTS}
        counts = [len(flights) for flights in of.values() if flights]
        if of[BASE] and len(counts) > 1:
            parts.append(f"#### {solver}, {min(counts)} seeds\n\n{comparison(MEASURES, of, BASE, 'mean per flight')}")
    return "\n\n".join(parts) if len(parts) > 1 else ""


def mass(rows: Sequence[Row]) -> str:
    """Errors of the mass, and the share within two sigmas."""
    lines = []
    for (solver, coupling), chosen in _hard(rows).items():
        for mark in sorted({mark for row in chosen for mark in row["mass"]}, key=float):
            if solver != HEADLINE and mark != EARLY:
                continue
            errors, sigmas = _known(chosen, mark)
            percents = (f"{100 * v:.2f}" for v in (np.median(errors), np.percentile(errors, 90), np.median(sigmas)))
            covered = f"{100 * float((errors <= 2.0 * sigmas).mean()):.0f}"
            lines.append([solver, coupling, mark, str(len(errors)), *percents, covered])
    head = ["solver", "coupling", "time [s]", "flights", "median error [%]", "90 % below", "sigma [%]", "covered [%]"]
    text = (
        "### The mass, believed wrong by 5 % at the start\n\n"
        f"Wanted: a median error below {100 * MASS_ERROR:g} % after 5 s, and the truth within two sigmas in at least "
        f"{100 * COVERED:g} % of the flights."
    )
    return _section(text, head, lines, 2)


def _known(rows: Sequence[Row], mark: str) -> tuple[Array, Array]:
    """(n,) size of the mass' relative error and (n,) its sigma, of the flights that lasted as long."""
    values = np.array([row["mass"][mark] for row in rows if mark in row["mass"]]).reshape(-1, 2)
    return np.abs(values[:, 0]), values[:, 1]


def _groups(rows: Iterable[Row]) -> dict[Key, list[Row]]:
    """Flights by study, solver and coupling, in words."""
    known = grouped((row for row in rows if row["study"] in TITLES), "study", "solver", "coupling")
    return {(TITLES[study], *words): flights for (study, *words), flights in known.items()}


def _hard(rows: Sequence[Row]) -> dict[Key, list[Row]]:
    """Flights with hard clearance that share a belief, by solver and coupling."""
    found = _groups(where(rows, study="flights"))
    return {words[1:]: chosen for words, chosen in found.items() if words[2] != "separate"}


def _section(text: str, head: Sequence[str], lines: Sequence[Sequence[str]], words: int) -> str:
    """A table with what stands before it, nothing when there are no lines."""
    return f"{text}\n\n{table(head, lines, words)}" if lines else ""
