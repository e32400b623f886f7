"""Experiments of Bazzana et al. 2022: legs of a department and a factory, control problems, manoeuvres.

The campaigns department.toml (Table I) and factory.toml (Table II) lie beside this file, with maps whose legs are about
as long as the paper's.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from unifg.errors import ScenarioError
from unifg.scenarios import manoeuvres
from unifg.scenarios.campaigns.campaign import run_campaign
from unifg.scenarios.campaigns.sheet import Sheet, load
from unifg.scenarios.campaigns.statement import Statement, read
from unifg.scenarios.campaigns.task import OK
from unifg.scenarios.papers.comparison import Comparison, Effort, Line, measured, stated
from unifg.scenarios.papers.control_instances import LOOP, Instance, Ours, bearings
from unifg.scenarios.papers.control_instances import PAPER as ROWS
from unifg.scenarios.papers.measuring import interleave
from unifg.scenarios.papers.printed import FOLDER, numbers, pairs, texts
from unifg.solvers import AugmentedLagrangian

RUNS = 30
BASES = {"light": "", "harsh": ", lagging and slipping base"}
PATIENCE = (170.0, 100.0)  # of a quick campaign on each of them [s]
LENGTH, DURATION = "path_length_m", "duration_s"
CLEARANCE, CONTACTS, TICK = "min_clearance_m", "collisions", "tick_ms.p50"
POSITION, HEADING = "localisation_error_m.mean", "localisation_error_rad.mean"
ROMAN = {"department": "I", "factory": "II"}  # tables of the paper
WHO = ("Ours", "ROS Navigation Stack")
PAPER = {
    name: {
        measure: [pairs("bazzana", f"Table {number} ({part}), {who}") for who in WHO]
        for measure, part in ((LENGTH, "a"), (DURATION, "b"))
    }
    for name, number in ROMAN.items()
}
"""Mean and standard deviation by campaign, measure, solver and leg, as printed."""


def campaign(name: str) -> Statement:
    """Campaign of a table, by the name of its map."""
    return read(FOLDER / f"{name}.toml")


def drives_of(sheet: Sheet, name: str) -> pd.DataFrame:
    """Drives of a campaign: planner (of this library, the coupling), table, leg, seed, outcome and measures."""
    found = []
    for combination in sheet.combinations:
        labels = dict(zip(sheet.axes, combination, strict=True))
        planner = labels.get("baseline", f"ours, {labels['coupling']}")
        mine = sheet.of(combination).join(sheet.values)
        found.append(mine.assign(planner=planner, table=ROMAN[name], leg=labels["leg"]))
    measures = [LENGTH, DURATION, CLEARANCE, CONTACTS, TICK, POSITION, HEADING]
    return pd.concat(found).reindex(columns=["planner", "table", "leg", "seed", "outcome", *measures])


def succeeded(drives: pd.DataFrame) -> pd.DataFrame:
    """Drives that succeeded."""
    return drives[drives["outcome"] == OK]


def relative(good: pd.DataFrame) -> pd.DataFrame:
    """Standard deviations of length and duration in per cent of the mean, by planner and leg."""
    values = good.groupby(["planner", "table", "leg"])[[LENGTH, DURATION]]
    return 100.0 * values.std() / values.mean()


def driven(
    effort: Effort, name: str, few: int, legs: Sequence[str] = (), plant: str = "light", patience: float = 240.0
) -> pd.DataFrame:
    """Drives of a campaign with the sequential coupling, run where they are not on file.

    Args:
        effort: quick or full.
        name: of the campaign.
        few: seeds of a quick one.
        legs: of a quick one; none for all.
        plant: one of `unifg.scenarios.simulation.drivetrain.PLANTS`.
        patience: after which a quick one ends with the drives there are [s].

    Raises:
        KeyboardInterrupt: the user has stopped it; drives that ended are on file.
        ScenarioError: no drive has ended by then.
    """
    whole = campaign(name)
    keep = {"coupling": ["sequential"], "leg": legs if effort.quick and legs else list(PAPER[name][LENGTH][0])}
    axes = tuple(
        replace(axis, values={label: given for label, given in axis.values.items() if label in keep[axis.name]})
        for axis in whole.axes
    )
    fixed = whole.fixed if plant == "light" else {**whole.fixed, "plant": plant}
    part = replace(whole, axes=axes, seeds=whole.seeds[: effort.of(few, RUNS)], fixed=fixed)
    folder, end = effort.folder / f"bazzana-{name}-{plant}", time.monotonic() + (patience if effort.quick else np.inf)

    def progress(done: float, text: str) -> None:
        effort.progress(done, text)
        if time.monotonic() > end:
            raise KeyboardInterrupt  # ends the campaign, what is done stays

    found = run_campaign(part, folder, workers=effort.workers, progress=progress)
    if found.interrupted and time.monotonic() <= end:
        raise KeyboardInterrupt(f"; drives in {folder}: {found.outcomes.total()}")
    if not found.outcomes:
        raise ScenarioError(f"no drive has ended within {patience:g} s: start the same command again, or with --full")
    return drives_of(load(folder, failed_too=True), name)


def _long_legs(effort: Effort, name: str, legs: Sequence[str]) -> Comparison:
    """Comparison of all legs, and of some of them in a quick one on the other base."""
    lines, counts = list[Line](), list[str]()
    for (plant, base), some, few, patience in zip(BASES.items(), ((), legs), (2, 3), PATIENCE, strict=True):
        drives = driven(effort, name, few, some, plant, patience)
        good = succeeded(drives)
        for measure, what in ((LENGTH, "length"), (DURATION, "duration")):
            unit = "m" if measure == LENGTH else "s"
            for leg, mine in good.groupby("leg", sort=False):
                mean, deviation = PAPER[name][measure][0][str(leg)]
                lines.append(measured(f"{leg}, {what} [{unit}]{base}", [mean], mine[measure], deviation=deviation))
            # the paper prints that of Table I alone
            spread = numbers("bazzana", "section VII-C", f"mean_spread_{what}")[:1] if name == "department" else []
            lines.append(measured(f"deviation of {what}, mean of legs [%]{base}", spread, relative(good)[measure]))
        runs = " to ".join(dict.fromkeys(str(end) for end in drives.groupby("leg").size().agg(["min", "max"])))
        counts.append(f"Runs of each leg{base}: {runs}, {len(good)} of {len(drives)} succeeded")
    text = f"{'. '.join(counts)}. Paper: {RUNS} runs; it gives neither map nor accelerations."
    return Comparison(lines, text)


def table_i(effort: Effort) -> Comparison:
    """Path lengths and durations of eight legs of a department."""
    return _long_legs(effort, "department", ("DE", "AB", "CD"))


def table_ii(effort: Effort) -> Comparison:
    """Path lengths and durations of four legs of a factory; the paper exchanges the durations of BC and CD."""
    found = _long_legs(effort, "factory", ("BC",))
    return replace(found, runs=f"{found.runs} Durations of BC and CD are exchanged in the paper.")


def table_iii(effort: Effort) -> Comparison:
    """Costs, iterations and times of the paper's loop on six control problems of its initial costs."""
    rounds, lines = effort.of(3, 15), list[Line]()
    for number, (row, bearing) in enumerate(zip(ROWS, bearings(), strict=True)):
        effort.progress(number / len(ROWS), f"initial cost {row[0]:.2f}")
        ours = Ours(AugmentedLagrangian(schedule="bazzana-damped", **LOOP))
        ours.state(Instance(bearing))
        seconds = interleave({"ours": ours}, rounds)["ours"]
        (cost, count, took), (_, found, iterations) = row[1], ours.outcome
        name = f"initial cost {row[0]:.2f}"
        lines += [
            measured(f"{name}: final cost", [cost], [found], 3),
            measured(f"{name}: iterations", [count], [iterations], 0),
            measured(f"{name}: time [ms]", [1e3 * took], 1e3 * seconds),
        ]
    text = "the paper's loop with Levenberg-Marquardt steps, his form; costs without one half"
    return Comparison(lines, f"{rounds} solves, {text}. Goals are chosen so that initial costs are the paper's.")


def figure_6(effort: Effort) -> Comparison:
    """Errors of localisation, means of the drives of Table I."""
    drives = driven(effort, "department", 2, ["DE", "AB", "CD"])
    printed = partial(numbers, "bazzana", "section VII-A, Fig. 6")
    lines = []
    for what, name, measure in (("position [m]", "translation", POSITION), ("heading [rad]", "rotation", HEADING)):
        mean, deviation = printed(name)
        lines.append(measured(f"error of {what}", [mean], succeeded(drives)[measure], 4, deviation))
    return Comparison(lines, f"{len(drives)} drives of {drives['leg'].nunique()} legs, a mean of each.")


def figure_7(effort: Effort) -> Comparison:
    """Statements about two manoeuvres, by both backends."""
    text, lines = texts("bazzana", "section VII-B, Fig. 7"), list[Line]()
    for solver in ("alm", "sqp"):
        behind, past = (manoeuvres.run_manoeuvre(manoeuvres.CASES[name], solver) for name in manoeuvres.CASES)
        slow = float(np.abs(behind.controls[behind.cusps, 0]).max()) if behind.cusps else np.inf
        kept = behind.within_limits and past.within_limits
        times = ", ".join(f"{t:.1f}" for t in past.time[past.inflections])
        there = [float(np.abs(past.controls[k - 1 : k + 1, 0]).max()) for k in past.inflections]
        slowest = min(there, default=0.0)
        lines += [
            stated(
                f"{solver}: cusps", text["cusp"], f"{len(behind.cusps)}, v = {slow:.3f} m/s", len(behind.cusps) == 1
            ),
            stated(f"{solver}: limits", text["limits"], "kept" if kept else "exceeded", kept),
            stated(
                f"{solver}: past the obstacle", text["inflection"],
                f"sign changes at {times} s, v there at least {slowest:.3f} m/s", slowest > 0.999,
            ),
        ]  # fmt: skip
    return Comparison(lines, "One solve of each by each backend; hard clearance, where the paper has a potential.")
