"""Bazzana's path lengths and durations again, on maps with legs as long as his. Writes docs/experiments.md.

    python -m benchmarks.experiments [--runs N] [--campaigns NAME ...] [--couplings NAME ...] [--workers K] [--report]
        [--any-code]

The campaigns are benchmarks/campaigns/department.toml (his Table I) and factory.toml (Table II), and for the same legs
with other planners department-others.toml and factory-others.toml. What is on file in out/benchmarks/campaigns or kept
in benchmarks/campaigns/rows is not repeated; all of it is on the page, and kept. Thirty runs a leg with two couplings
take some two hours of one core, those of the four other planners some six.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.comparison import interval, share
from benchmarks.kept_rows import ROWS, keep, restore
from benchmarks.large_maps import CAMPAIGNS
from benchmarks.printed import numbers, pairs
from benchmarks.report import OUT, command, machine, publish, table
from unifg.scenarios.campaigns.account import PAIRED, differences
from unifg.scenarios.campaigns.campaign import EPISODES, code_of_scenario, replay_command, run_campaign, write_manifest
from unifg.scenarios.campaigns.performed import OK
from unifg.scenarios.campaigns.sheet import Combination, Sheet, load
from unifg.scenarios.campaigns.statement import Statement, read
from unifg.scenarios.ground.drive_pilot import COUPLINGS
from unifg.typing import Array

RUNS = 30
LENGTH, DURATION = "path_length_m", "duration_s"
CLEARANCE, CONTACTS, TICK = "min_clearance_m", "collisions", "tick_ms.p50"
OTHERS = "-others"  # ends the name of the campaign of the same legs with other planners
Pair = tuple[float, float]
"""Mean and standard deviation."""


@dataclass(frozen=True)
class Reported:
    """What the paper reports of a leg: path length [m] and duration [s], his and those of the ROS stack."""

    length: Pair
    duration: Pair
    ros_length: Pair
    ros_duration: Pair


def _reported(table: str) -> dict[str, Reported]:
    """A table of the paper by legs."""
    ours, ros = "Ours", "ROS Navigation Stack"
    columns = [pairs("bazzana", f"{table} ({part}), {who}") for who in (ours, ros) for part in "ab"]
    return {leg: Reported(*(column[leg] for column in columns)) for leg in columns[0]}


PAPER = {"department": _reported("Table I"), "factory": _reported("Table II")}
TITLES = {"department": "Table I: eight legs of a department", "factory": "Table II: four legs of a factory"}
CAMPAIGN_NAMES = (*PAPER, *(name + OTHERS for name in PAPER))


def rendered(sheets: Mapping[str, Sheet]) -> str:
    """All tables, and what they say together."""
    parts = list[str]()
    ours = {name: sheet for name, sheet in sheets.items() if name in PAPER}
    for name, sheet in ours.items():
        parts += [f"### {TITLES[name]}", lengths(sheet, PAPER[name]), durations(sheet, PAPER[name]), *_compared(sheet)]
        parts += _failed(sheet)
    parts.append(together(list(ours.values())))
    drives = [drive for name, sheet in sheets.items() for drive in drivers(sheet, name.removesuffix(OTHERS))]
    if len({drive.planner for drive in drives}) > 1:
        parts += ["### The same legs with other planners", beside(drives), leg_by_leg(drives)]
        parts += [part for name, sheet in sheets.items() if name not in PAPER for part in _failed(sheet)]
    parts.append(machine("numpy", "scipy", "osqp", "piqp", "pymunk"))
    return "\n\n".join(parts)


@dataclass(frozen=True)
class Driver:
    """A planner on a leg.

    Attributes:
        planner: its short name; of this library, the coupling.
        leg: the table and the leg.
        sheet: of its campaign.
        combination: there.
    """

    planner: str
    leg: str
    sheet: Sheet
    combination: Combination

    def all(self, measure: str) -> Array:
        """(n,) numbers of all drives that came to an end."""
        return self.sheet.column(measure, self.combination)

    def good(self, measure: str) -> Array:
        """(n,) those of drives that succeeded."""
        return self.sheet.column(measure, self.combination, OK)

    @property
    def counts(self) -> tuple[int, int]:
        """How many drives, and how many succeeded."""
        counts = self.sheet.counts(self.combination)
        return counts.total(), counts[OK]


def drivers(sheet: Sheet, name: str) -> list[Driver]:
    """Who has driven which leg of a campaign."""
    found = []
    for combination in sheet.combinations:
        labels = dict(zip(sheet.axes, combination, strict=True))
        planner = labels.get("baseline", f"ours, {labels['coupling']}")
        found.append(Driver(planner, f"{'I' if name == 'department' else 'II'} {labels['leg']}", sheet, combination))
    return found


def beside(drives: Sequence[Driver]) -> str:
    """Every planner over all legs it has driven; extra time is the mean over pairs of leg and seed."""
    head = (
        "planner", "legs", "drives", "succeeded", "95 %", "contacts", "least clearance [mm]",
        "its mean over drives [mm]", "std of length", "std of duration", "longer than ours by [s]", "tick [ms]",
    )  # fmt: skip
    rows, base = [], _times([drive for drive in drives if drive.planner == drives[0].planner])
    for planner in dict.fromkeys(drive.planner for drive in drives):
        mine = [drive for drive in drives if drive.planner == planner]
        runs, good = np.sum([drive.counts for drive in mine], axis=0)
        low, high = share(int(good), int(runs))
        clearance, contacts = _pooled(mine, CLEARANCE), _pooled(mine, CONTACTS)
        times = _times(mine)
        extra = np.array([times[key] - base[key] for key in times if key in base])
        rows.append((
            planner, str(len(mine)), str(runs), str(good), f"{100 * low:.0f} .. {100 * high:.0f} %",
            f"{contacts.sum():.0f}", f"{1e3 * clearance.min(initial=np.inf):.0f}", f"{1e3 * clearance.mean():.0f}",
            _relative(mine, LENGTH), _relative(mine, DURATION),
            "-" if mine[0].planner == drives[0].planner or len(extra) < 2 else
            "{:.1f} ({:.1f} .. {:.1f})".format(extra.mean(), *interval(extra)),
            f"{np.median(_pooled(mine, TICK)):.1f}",
        ))  # fmt: skip
    words = (
        "Contacts and clearances are of all drives, the rest is of those that succeeded: spreads are means over legs, "
        f"times are compared drive by drive with those of *{drives[0].planner}* on the same leg and seed, with a "
        "bootstrap interval; a tick is the median over drives of their medians."
    )
    return f"{table(head, rows)}\n\n{words}"


def leg_by_leg(drives: Sequence[Driver]) -> str:
    """Every planner on every leg."""
    head = (
        "leg", "planner", "drives", "succeeded", "path length [m]", "duration [s]", "least clearance [mm]", "contacts",
    )  # fmt: skip
    rows = []
    for leg in dict.fromkeys(drive.leg for drive in drives):
        for drive in drives:
            if drive.leg == leg:
                runs, good = drive.counts
                clearance = drive.all(CLEARANCE)
                rows.append((
                    leg, drive.planner, str(runs), str(good),
                    _spread(drive.good(LENGTH)), _spread(drive.good(DURATION)),
                    f"{1e3 * clearance.min():.0f}" if len(clearance) else "-", f"{drive.all(CONTACTS).sum():.0f}",
                ))  # fmt: skip
    return table(head, rows, 2)


def _pooled(drives: Sequence[Driver], measure: str) -> Array:
    return np.concatenate([np.zeros(0), *(drive.all(measure) for drive in drives)])


def _relative(drives: Sequence[Driver], measure: str) -> str:
    """Mean over legs of the standard deviation in per cent of the mean."""
    found = [drive.good(measure) for drive in drives]
    shares = [100.0 * float(values.std(ddof=1) / values.mean()) for values in found if len(values) > 1]
    return f"{np.mean(shares):.2f} %" if shares else "-"


def _times(drives: Sequence[Driver]) -> dict[tuple[str, int | None], float]:
    """Durations of the drives that succeeded, by leg and seed."""
    found = dict[tuple[str, int | None], float]()
    for drive in drives:
        mine = drive.sheet.of(drive.combination).join(drive.sheet.by_episode(DURATION).rename("duration"))
        mine = mine[mine["outcome"] == OK].dropna(subset="duration")
        found |= {(drive.leg, row["seed"]): row["duration"] for row in mine.to_dict("records")}
    return found


def lengths(sheet: Sheet, paper: Mapping[str, Reported]) -> str:
    """Path length, mean, standard deviation and the same in per cent."""
    head = ("leg", "coupling", "runs", "succeeded", "path length [m]", "95 % interval", "paper: his [m]", "ROS [m]")
    rows = []
    for coupling, leg in sheet.combinations:
        his, ros = paper[leg].length, paper[leg].ros_length
        rows.append((*_begin(sheet, (coupling, leg), LENGTH), _pair(his), _pair(ros)))
    return table(head, rows, 2)


def durations(sheet: Sheet, paper: Mapping[str, Reported]) -> str:
    """Durations, likewise."""
    head = ("leg", "coupling", "runs", "succeeded", "duration [s]", "95 % interval", "paper: his [s]", "ROS [s]")
    rows = [
        (*_begin(sheet, (coupling, leg), DURATION), _pair(paper[leg].duration), _pair(paper[leg].ros_duration))
        for coupling, leg in sheet.combinations
    ]
    return table(head, rows, 2)


def _begin(sheet: Sheet, combination: Combination, measure: str) -> tuple[str, ...]:
    values, counts = sheet.column(measure, combination, OK), sheet.counts(combination)
    coupling, leg = combination
    return leg, coupling, str(counts.total()), str(counts[OK]), _spread(values), _inside(values)


def _spread(values: Array) -> str:
    if not len(values):
        return "-"
    if len(values) == 1:
        return f"{values[0]:.2f}"
    return _pair((float(values.mean()), float(values.std(ddof=1))))


def _inside(values: Array) -> str:
    return "{:.2f} to {:.2f}".format(*interval(values)) if len(values) > 1 else "-"


def _pair(pair: Pair) -> str:
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


def together(sheets: Sequence[Sheet]) -> str:
    """What the paper says of all legs together."""
    spreads: dict[str, list[float]] = {LENGTH: [], DURATION: []}
    simulated, drives, runs = 0.0, 0, Counter[int]()
    for sheet in sheets:
        for combination in sheet.combinations:
            for measure, found in spreads.items():
                values = sheet.column(measure, combination, OK)
                if len(values) > 1:
                    found.append(100.0 * float(values.std(ddof=1) / values.mean()))
            simulated += float(sheet.column(DURATION, combination).sum())
            drives += len(sheet.of(combination))
            runs[len(sheet.of(combination))] += 1
    seconds = sum(sheet.cpu_seconds for sheet in sheets)
    least, most = min(runs, default=0), max(runs, default=0)
    many = f"{least} to {most}" if least < most else str(most)
    say = [f"{drives} drives, {many} of each leg and coupling in the tables (the paper: {RUNS} of each leg)."]
    if all(spreads.values()):
        length, duration = spreads[LENGTH], spreads[DURATION]
        section = partial(numbers, "bazzana", "section VII-B")
        (mean, mean_ros), (mean_s, mean_s_ros) = section("mean_spread_length"), section("mean_spread_duration")
        (top, top_s), (top_ros, top_s_ros) = section("greatest_spread"), section("greatest_spread_ros")
        say.append(
            f"The standard deviation is on average {np.mean(length):.2f} % of the path length (paper: {mean:.2f} %; "
            f"ROS: {mean_ros:.2f} %), at most {max(length):.2f} % ({top:.2f} %; {top_ros:.2f} %), and "
            f"{np.mean(duration):.2f} % of the duration ({mean_s:.2f} %; {mean_s_ros:.2f} %), at most "
            f"{max(duration):.2f} % ({top_s:.2f} %; {top_s_ros:.2f} %)."
        )
    factor = simulated / max(seconds, 1e-9)
    say.append(
        f"{simulated / 3600.0:.2f} h were driven in {seconds / 3600.0:.2f} h of a processor, {factor:.1f} times real "
        f"time (the paper: {numbers('bazzana', 'section VII-B', 'hours')[0]:g} h for Table I)."
    )
    return " ".join(say)


def _some(statement: Statement, runs: int, couplings: Sequence[str]) -> Statement:
    """The first runs of a campaign, with some couplings."""
    axes = [
        replace(axis, values={label: axis.values[label] for label in axis.values if label in couplings})
        if axis.name == "coupling" else axis
        for axis in statement.axes
    ]  # fmt: skip
    return replace(statement, seeds=statement.seeds[:runs], axes=tuple(axes))


def main(arguments: list[str] | None = None) -> int:
    """Drive what is missing, then write the page."""
    parser = command(__doc__)
    parser.add_argument("--runs", type=int, default=RUNS, help="of each leg and coupling; the page says how many")
    parser.add_argument("--campaigns", nargs="+", choices=CAMPAIGN_NAMES, default=CAMPAIGN_NAMES, help="to go on with")
    parser.add_argument("--couplings", nargs="+", choices=COUPLINGS, default=COUPLINGS, help="of this library's drives")
    parser.add_argument("--workers", type=int, default=1, help="processes; times are those of one alone")
    parser.add_argument("--report", action="store_true", help="run nothing, write the tables from what is on file")
    parser.add_argument("--any-code", action="store_true", help="drives of earlier states of the code count, too")
    options = parser.parse_args(arguments)
    sheets = {}
    for name in CAMPAIGN_NAMES:
        folder, archive = OUT / "campaigns" / name, ROWS / f"{name}.jsonl.xz"
        store = folder / EPISODES
        whole = read(CAMPAIGNS / f"{name}.toml")
        restore(archive, store)
        if not options.report and name in options.campaigns:
            couplings = options.couplings if name in PAPER else COUPLINGS
            some = _some(whole, options.runs, couplings)
            run_campaign(some, folder, workers=options.workers, any_code=options.any_code)
            keep(store, archive)
        if folder.is_dir():
            write_manifest(folder, whole, code_of_scenario("navigation"))  # not of this command's part alone
            sheets[name] = load(folder, options.any_code, failed_too=True)
    publish("experiments", rendered(sheets))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
