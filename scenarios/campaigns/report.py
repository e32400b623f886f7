"""Report of a campaign: outcomes, tables and pictures of measures, differences between settings, failures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from unifg.atomic_write import write_atomically
from unifg.scenarios.campaigns.campaign import replay_command
from unifg.scenarios.campaigns.campaign_plot import outcomes_picture, values_picture
from unifg.scenarios.campaigns.comparison import by_chance, digits, interval, share
from unifg.scenarios.campaigns.document import Document
from unifg.scenarios.campaigns.sheet import OUTCOMES, Sheet, load
from unifg.scenarios.campaigns.task import OK
from unifg.style.figures import write_figure
from unifg.typing import Array

__all__ = ["PAIRED", "Table", "consistency", "differences", "outcome_table", "value_table", "write_report"]

NEES, DIMENSION = "nees.drawn", 3  # measure of a drive, and its degrees of freedom
FIRST = 6  # measures in front where a campaign states none
LISTED = 200  # failures that are listed
FOLDER = "report"  # of pictures, inside that of the campaign
PAIRED = (
    "Pairs of episodes with the same seed that differ in {axis} alone. p: how likely a mean difference as large is "
    "when signs are by chance (sign-flip test); Holm: the same, corrected for the number of rows of this table."
)


class Table(NamedTuple):
    """Head, rows, and the number of columns that are words."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int


def write_report(folder: Path, against: Path | None = None, any_code: bool = False) -> list[Path]:
    """Write ``report.html``, which needs nothing else, and ``report.md`` with its pictures beside it.

    Args:
        folder: of a campaign, finished or not.
        against: of another one, whose episodes are compared with those of the same labels and seeds.
        any_code: episodes that other states of the code have run count, too.

    Returns:
        The files.

    Raises:
        ScenarioError: there is no campaign.
        OSError: the files cannot be written.
    """
    sheet = load(folder, any_code)
    pictures, document = folder / FOLDER, Document(sheet.title, folder)
    pictures.mkdir(exist_ok=True)
    measures = sheet.measures
    shown = [m for m in sheet.stated if m in sheet.values] or measures[:FIRST]
    rest = [m for m in measures if m not in shown]
    document.words(_beginning(sheet))
    document.heading("How episodes ended")
    document.table(*outcome_table(sheet))
    if len(sheet.episodes):
        file = write_figure(pictures / "outcomes.png", outcomes_picture(sheet), 110)
        document.picture(file, "share of episodes that succeeded")
    document.heading("Measures")
    whom = "episodes that succeeded" if sheet.succeeded_only else "all episodes that came to an end, failed ones too"
    document.words(f"Of {whom}. n counts those whose measure is a finite number; intervals are by bootstrap.")
    for number, measure in enumerate(shown):
        document.words(f"{measure}:")
        document.table(*value_table(sheet, measure))
        picture = write_figure(pictures / f"measure-{number}.png", values_picture(sheet, measure), 110)
        document.picture(picture, measure)
    if rest:
        with document.fold(f"{len(rest)} more measures"):
            for measure in rest:
                document.words(f"{measure}:")
                document.table(*value_table(sheet, measure))
    if verdict := consistency(sheet):
        document.heading("Consistency of the estimate")
        document.words(verdict)
    for axis, table in differences(sheet, shown).items():
        document.heading(f"{axis}: differences")
        document.words(PAIRED.format(axis=axis))
        document.table(*table)
    if against is not None:
        _beside(document, sheet, load(against, any_code), shown)
    _failures(document, sheet)
    files = folder / "report.html", folder / "report.md"
    write_atomically(files[0], document.html())
    write_atomically(files[1], document.markdown)
    return list(files)


def outcome_table(sheet: Sheet) -> Table:
    """Counts of the outcomes of every combination, and the share that succeeds with a 95 % interval (Wilson)."""
    rows = []
    for combination in sheet.combinations:
        counts = sheet.counts(combination)
        low, high = share(counts[OK], counts.total())
        numbers = (str(counts.total()), *(str(counts[name]) for name in OUTCOMES))
        rows.append(
            (*combination, *numbers, f"{100 * counts[OK] / counts.total():.0f}", f"{100 * low:.0f} to {100 * high:.0f}")
        )
    return Table((*sheet.axes, "n", *OUTCOMES, "succeeded %", "95 % interval"), rows, len(sheet.axes))


def value_table(sheet: Sheet, measure: str) -> Table:
    """Number, mean, standard deviation, the same in per cent of the mean, a 95 % interval of the mean, extremes."""
    rows = [(*combination, *_told(sheet.column(measure, combination))) for combination in sheet.combinations]
    head = (*sheet.axes, "n", "mean", "std", "std %", "95 % interval of the mean", "least", "greatest")
    return Table(head, rows, len(sheet.axes))


def consistency(sheet: Sheet) -> str:
    """Verdict on the covariances of the estimate, by the NEES of one tick drawn per drive; nothing without drives.

    Draws of different drives are independent, so their mean times their number is chi-squared with three degrees of
    freedom for each (Bar-Shalom et al. 2001, section 5.4).
    """
    drawn = sheet.by_episode(NEES).dropna()
    if not len(drawn):
        return ""
    low, high = (float(2.0 * gammaincinv(0.5 * DIMENSION * len(drawn), p) / len(drawn)) for p in (0.025, 0.975))
    mean = float(drawn.mean())
    verdict = "too small" if mean > high else "too large" if mean < low else "consistent with the errors"
    return (
        f"Mean NEES of one tick drawn per drive, over {len(drawn)} drives: {mean:.2f}; {DIMENSION} is expected, "
        f"95 % band {low:.2f} to {high:.2f}. The covariances are {verdict}."
    )


def differences(sheet: Sheet, measures: Sequence[str]) -> dict[str, Table]:
    """Paired comparisons by axis: every value with the first one, where seeds and all other axes are the same."""
    tables = {}
    for axis in sheet.compare:
        where, (base, *others) = list(sheet.axes).index(axis), sheet.axes[axis]
        place = sheet.episodes["combination"]
        label, rest = place.str[where], place.map(lambda labels, k=where: (*labels[:k], *labels[k + 1 :]))
        found = []
        for measure in measures:
            told = pd.DataFrame({"label": label, "rest": rest, "seed": sheet.episodes["seed"]})
            told = told.join(sheet.by_episode(measure).rename("value")).dropna(subset="value")
            of = dict(iter(told.groupby("label")))
            for other in others:
                if other in of and base in of:
                    pairs = of[other].merge(of[base], on=["rest", "seed"])
                    found.append((measure, f"{other} - {base}", _sorted(pairs["value_x"] - pairs["value_y"])))
        found = [row for row in found if len(row[2])]
        if found:
            tables[axis] = _difference_table(found)
    return tables


def _beginning(sheet: Sheet) -> str:
    words = (
        f"{len(sheet.episodes)} of {sheet.expected} episodes, {sheet.seconds / 3600:.2f} h of work, code "
        f"`{sheet.code}`."
    )
    if sheet.others:
        words += f" {sheet.others} rows of other states of the code are left out."
    if sheet.unreadable:
        words += f" {len(sheet.unreadable)} lines of the file cannot be read."
    return words


def _told(values: Array) -> tuple[str, ...]:
    if not len(values):
        return ("0", *["-"] * 6)
    mean, least, greatest = float(values.mean()), f"{values.min():.5g}", f"{values.max():.5g}"
    if len(values) == 1:
        return ("1", f"{mean:.5g}", "-", "-", "-", least, greatest)
    std, (low, high) = float(values.std(ddof=1)), interval(values)
    part = f"{100 * std / abs(mean):.2f}" if mean else "-"
    return (str(len(values)), f"{mean:.5g}", f"{std:.3g}", part, f"{low:.5g} to {high:.5g}", least, greatest)


def _sorted(values: pd.Series[float]) -> Array:
    """(n,) from the least on: the bootstrap does not depend on the order of the file."""
    return np.sort(values.to_numpy(dtype=float))


def _difference_table(found: Sequence[tuple[str, str, Array]]) -> Table:
    chances = [by_chance(pairs) for _, _, pairs in found]
    rows = []
    for (measure, what, pairs), p, holm in zip(found, chances, _holm(chances), strict=True):
        low, high = interval(pairs) if len(pairs) > 1 else (np.nan, np.nan)
        inside = "-" if np.isnan(low) else f"{digits(low, '+')} to {digits(high, '+')}"
        rows.append(
            (measure, what, str(len(pairs)), digits(float(pairs.mean()), "+"), inside, f"{p:.3f}", f"{holm:.3f}")
        )
    return Table(("measure", "difference", "pairs", "mean", "95 % interval", "p", "Holm"), rows, 2)


def _holm(chances: Sequence[float]) -> list[float]:
    """Corrected for their number (Holm 1979)."""
    order = np.argsort(chances, kind="stable")
    scaled = np.minimum(1.0, np.arange(len(chances), 0, -1) * np.array(chances)[order])
    found = np.empty(len(chances))
    found[order] = np.maximum.accumulate(scaled)
    return [float(value) for value in found]


def _beside(document: Document, sheet: Sheet, other: Sheet, measures: Sequence[str]) -> None:
    """Add a comparison with the episodes of another campaign that have the same labels and seeds."""
    document.heading(f"Against {other.folder}")
    document.words(
        f"There: code `{other.code}`. Differences are here - there, of episodes with the same labels and seed."
    )
    both = sheet.episodes.reset_index().merge(other.episodes.reset_index(), on=["combination", "seed"])
    found = []
    for measure in measures:
        here = sheet.by_episode(measure).reindex(both["index_x"]).to_numpy()
        there = other.by_episode(measure).reindex(both["index_y"]).to_numpy()
        found.append((measure, "here - there", _sorted(pd.Series(here - there, dtype=float).dropna())))
    found = [row for row in found if len(row[2])]
    if not found:
        document.words("No episode of one has the labels and seed of one of the other.")
        return
    document.table(*_difference_table(found))
    good, was_good = both["outcome_x"] == OK, both["outcome_y"] == OK
    for words, folder, key, which in (
        ("ok there, not here", sheet.folder, "key_x", both[was_good & ~good]),
        ("ok here, not there", other.folder, "key_y", both[good & ~was_good]),
    ):
        document.words(f"{words}: {len(which)}.")
        rows = [
            (*row["combination"], str(row["seed"]), replay_command(folder, row[key]))
            for row in which.head(LISTED).to_dict("records")
        ]
        if rows:
            document.table((*sheet.axes, "seed", "command"), rows, len(sheet.axes) + 2)


def _failures(document: Document, sheet: Sheet) -> None:
    failures = sheet.failures
    if not len(failures):
        document.heading("Failures")
        document.words("None.")
        return
    rows = [
        (*f["combination"], str(f["seed"]), f["outcome"], f["why"][:200], replay_command(sheet.folder, f["key"]))
        for f in failures.head(LISTED).to_dict("records")
    ]
    more = f" The first {LISTED} of {len(failures)}." if len(failures) > LISTED else ""
    document.heading(f"{len(failures)} failures")
    document.words(f"Each with the command that runs it again, with scene and pictures.{more}")
    document.table((*sheet.axes, "seed", "outcome", "why", "command"), rows, len(sheet.axes) + 4)
