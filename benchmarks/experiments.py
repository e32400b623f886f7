"""Bazzana's path lengths and durations, on maps with legs as long as his.

The campaigns are those of :mod:`unifg.scenarios.papers.bazzana`, and the same legs with :data:`BASELINES`. Drives on
file in out/benchmarks/campaigns or kept in benchmarks/campaigns/rows are not repeated. Thirty runs a leg with two
couplings take some two hours of one core, those of the four other planners some six.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from benchmarks.comparison import interval, portion
from benchmarks.kept_rows import ROWS, keep, restore
from benchmarks.report import CAMPAIGNS, OUT, table
from benchmarks.runner import Timing
from unifg.scenarios.campaigns.campaign import EPISODES, code_of, replay_command, run_campaign, write_manifest
from unifg.scenarios.campaigns.report import PAIRED, differences
from unifg.scenarios.campaigns.sheet import Sheet, load
from unifg.scenarios.campaigns.statement import Statement, read, stated
from unifg.scenarios.campaigns.task import OK
from unifg.scenarios.papers.bazzana import (
    CLEARANCE,
    CONTACTS,
    DURATION,
    LENGTH,
    PAPER,
    ROMAN,
    RUNS,
    TICK,
    campaign,
    drives_of,
    relative,
    succeeded,
)
from unifg.scenarios.papers.printed import numbers

OTHERS = "-others"  # ends the name of the campaign with other planners
EARLIER = CAMPAIGNS / "department.toml"  # legs that they drove in the department
WHERE = "On the legs of Table II, and on legs of Table I between earlier places: AC is 184 m long there, BD 165 m."
TITLES = {"department": "Table I: eight legs of a department", "factory": "Table II: four legs of a factory"}
CAMPAIGN_NAMES = (*PAPER, *(name + OTHERS for name in PAPER))
OURS = "ours, sequential"
BASELINES = {
    "teb": "elastic_band:ElasticBand", "mppi": "path_integral:PathIntegral", "dwa": "dynamic_window:DynamicWindow",
    "pursuit": "pure_pursuit:PurePursuit",
}  # fmt: skip
"""Other local planners, within the same limits of speed and acceleration, in benchmarks.baselines."""


def statement(name: str) -> Statement:
    """Campaign by name; with other planners on the legs of the factory, and on earlier ones of the department."""
    if not name.endswith(OTHERS):
        return campaign(name)
    earlier = name.startswith(EARLIER.stem)
    whole = read(EARLIER) if earlier else campaign(name.removesuffix(OTHERS))
    others = [{"name": label, "planner": f"benchmarks.baselines.{made}"} for label, made in BASELINES.items()]
    others = [{"name": OURS}, *others] if earlier else others
    grid = {**whole.given["grid"], "coupling": ["sequential"], "baseline": others}
    title = f"{whole.title}, other planners"
    return stated({**whole.given, "title": title, "grid": grid}, whole.base, name)


def rendered(sheets: Mapping[str, Sheet]) -> str:
    """All tables, and sentences about them together."""
    parts = list[str]()
    each = {name: drives_of(sheet, name.removesuffix(OTHERS)) for name, sheet in sheets.items()}
    ours = pd.concat([each[name] for name in sheets if name in PAPER])
    for name in (name for name in sheets if name in PAPER):
        mine = ours[ours["table"] == ROMAN[name]]
        parts += [f"### {TITLES[name]}", reported(mine, PAPER[name], LENGTH), reported(mine, PAPER[name], DURATION)]
        parts += [*_compared(sheets[name]), *_failed(sheets[name])]
    parts.append(together(ours, sum(sheet.cpu_seconds for name, sheet in sheets.items() if name in PAPER)))
    if set(sheets) - set(PAPER):
        compared = pd.concat([each[name] for name in sheets if name != EARLIER.stem])
        parts += ["### Other planners", WHERE, beside(compared), leg_by_leg(compared)]
        parts += [part for name, sheet in sheets.items() if name not in PAPER for part in _failed(sheet)]
    return "\n\n".join(parts)


def beside(drives: pd.DataFrame) -> str:
    """Every planner over all legs it has driven; extra time is the mean over pairs of leg and seed."""
    head = (
        "planner", "legs", "drives", "succeeded", "95 %", "contacts", "least clearance [mm]",
        "its mean over drives [mm]", "std of length", "std of duration", "longer than ours by [s]", "tick [ms]",
    )  # fmt: skip
    rows, pair = [], ["table", "leg", "seed"]
    first = drives["planner"].iloc[0]
    base = succeeded(drives[drives["planner"] == first]).set_index(pair)[DURATION]
    for planner, mine in drives.groupby("planner", sort=False):
        good = succeeded(mine)
        extra = (good.set_index(pair)[DURATION] - base).dropna().to_numpy()
        spreads = relative(good)
        rows.append((
            str(planner), str(mine.groupby(["table", "leg"]).ngroups), str(len(mine)), str(len(good)),
            portion(len(good), len(mine)), f"{mine[CONTACTS].sum():.0f}",
            f"{1e3 * mine[CLEARANCE].min():.0f}", f"{1e3 * mine[CLEARANCE].mean():.0f}",
            *(f"{spreads[measure].mean():.2f} %" for measure in (LENGTH, DURATION)),
            "-" if planner == first or len(extra) < 2 else
            "{:.1f} ({:.1f} .. {:.1f})".format(extra.mean(), *interval(extra)),
            f"{mine[TICK].median():.1f}",
        ))  # fmt: skip
    words = (
        "Contacts and clearances are of all drives, the rest is of those that succeeded: spreads are means over legs, "
        f"times are compared drive by drive with those of *{first}* on the same leg and seed, with a "
        "bootstrap interval; a tick is the median over drives of their medians."
    )
    return f"{table(head, rows)}\n\n{words}"


def leg_by_leg(drives: pd.DataFrame) -> str:
    """Every planner on every leg."""
    head = (
        "leg", "planner", "drives", "succeeded", "path length [m]", "duration [s]", "least clearance [mm]", "contacts",
    )  # fmt: skip
    rows = []
    for (number, leg), driven in drives.groupby(["table", "leg"], sort=False):
        for planner, mine in driven.groupby("planner", sort=False):
            good = succeeded(mine)
            rows.append((
                f"{number} {leg}", str(planner), str(len(mine)), str(len(good)), _spread(good[LENGTH]),
                _spread(good[DURATION]), f"{1e3 * mine[CLEARANCE].min():.0f}", f"{mine[CONTACTS].sum():.0f}",
            ))  # fmt: skip
    return table(head, rows, 2)


def reported(
    drives: pd.DataFrame, paper: Mapping[str, Sequence[Mapping[str, tuple[float, float]]]], measure: str
) -> str:
    """Mean and standard deviation of a measure, by leg and coupling, beside the paper's."""
    what = "path length [m]" if measure == LENGTH else "duration [s]"
    unit = what[-3:]
    head = ("leg", "coupling", "runs", "succeeded", what, "95 % interval", f"paper: his {unit}", f"ROS {unit}")
    rows = []
    for (planner, leg), mine in drives.groupby(["planner", "leg"], sort=False):
        values = succeeded(mine)[measure].dropna()
        inside = "{:.2f} to {:.2f}".format(*interval(values.to_numpy())) if len(values) > 1 else "-"
        theirs = [_pair(column[str(leg)]) for column in paper[measure]]
        coupling = str(planner).removeprefix("ours, ")
        rows.append((str(leg), coupling, str(len(mine)), str(len(values)), _spread(values), inside, *theirs))
    return table(head, rows, 2)


def _spread(values: pd.Series[float]) -> str:
    known = values.dropna()
    if len(known) < 2:
        return f"{known.iloc[0]:.2f}" if len(known) else "-"
    return _pair((float(known.mean()), float(known.std())))


def _pair(pair: tuple[float, float]) -> str:
    mean, std = pair
    return f"{mean:.2f} ± {std:.2f} ({100.0 * std / mean:.2f} %)"


def _compared(sheet: Sheet) -> list[str]:
    """The two couplings, pair by pair, where both succeeded."""
    measures = [m for m in sheet.stated if m in sheet.values]
    good = replace(sheet, values=sheet.values[sheet.episodes["outcome"] == OK])
    return [
        text
        for axis, found in differences(good, measures).items()
        for text in (PAIRED.format(axis=axis), table(*found))
    ]


def _failed(sheet: Sheet) -> list[str]:
    lines = [f"{len(sheet.failures)} of {len(sheet.episodes)} drives failed."]
    for f in sheet.failures.head(20).to_dict("records"):
        where = replay_command(Path("out/benchmarks/campaigns") / sheet.folder.name, f["key"])
        lines.append(f"- {', '.join(f['combination'])}, seed {f['seed']}: {f['why'] or f['outcome']}; `{where}`")
    return ["\n".join(lines)]


def together(drives: pd.DataFrame, seconds: float) -> str:
    """Sentences about all legs together, beside the paper's.

    Args:
        drives: of this library.
        seconds: of a processor.
    """
    runs = drives.groupby(["planner", "table", "leg"]).size()
    many = f"{runs.min()} to {runs.max()}" if runs.min() < runs.max() else str(runs.max())
    say = [f"{len(drives)} drives, {many} of each leg and coupling in the tables (the paper: {RUNS} of each leg)."]
    spreads = relative(succeeded(drives[drives["table"] == ROMAN["department"]])).dropna()  # which the paper speaks of
    if len(spreads):
        section = partial(numbers, "bazzana", "section VII-C")
        (mean, mean_ros), (mean_s, mean_s_ros) = section("mean_spread_length"), section("mean_spread_duration")
        (top, top_s), (top_ros, top_s_ros) = section("greatest_spread"), section("greatest_spread_ros")
        say.append(
            f"In Table I the standard deviation is on average {spreads[LENGTH].mean():.2f} % of the path length "
            f"(paper: {mean:.2f} %; ROS: {mean_ros:.2f} %), at most {spreads[LENGTH].max():.2f} % ({top:.2f} %; "
            f"{top_ros:.2f} %), and {spreads[DURATION].mean():.2f} % of the duration ({mean_s:.2f} %; {mean_s_ros:.2f} "
            f"%), at most {spreads[DURATION].max():.2f} % ({top_s:.2f} %; {top_s_ros:.2f} %)."
        )
    simulated = float(drives[DURATION].sum())
    say.append(
        f"{simulated / 3600.0:.2f} h were driven in {seconds / 3600.0:.2f} h of a processor, "
        f"{simulated / max(seconds, 1e-9):.1f} times real time (the paper: "
        f"{numbers('bazzana', 'section VII-C', 'hours')[0]:g} h for Table I)."
    )
    return " ".join(say)


def tables(runs: int) -> str:
    """Drive what is missing of the first runs of all campaigns; the tables of all drives on file."""
    sheets = {}
    for name in CAMPAIGN_NAMES:
        folder, archive = OUT / "campaigns" / name, ROWS / f"{name}.jsonl.xz"
        whole = statement(name)
        restore(archive, folder / EPISODES)
        run_campaign(replace(whole, seeds=whole.seeds[:runs]), folder, any_code=True)
        keep(folder / EPISODES, archive)
        write_manifest(folder, whole, code_of(whole))  # not of the first runs alone
        sheets[name] = load(folder, any_code=True, failed_too=True)
    return rendered(sheets)


STUDY = Timing(tables, RUNS)
