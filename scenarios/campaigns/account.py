"""What a campaign says: how episodes ended, tables and pictures of measures, differences between settings, failures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import gammaincinv

from unifg.scenarios.campaigns.campaign import replay_command
from unifg.scenarios.campaigns.campaign_plot import outcomes_picture, values_picture
from unifg.scenarios.campaigns.comparison import by_chance, digits, interval, share
from unifg.scenarios.campaigns.document import (
    Block,
    Fold,
    Heading,
    Picture,
    Table,
    Words,
    as_html,
    as_markdown,
)
from unifg.scenarios.campaigns.performed import OK
from unifg.scenarios.campaigns.sheet import OUTCOMES, Combination, Sheet, load
from unifg.style.figures import write_figure
from unifg.typing import Array
from unifg.whole import write_whole

__all__ = ["consistency", "differences", "outcome_table", "value_table", "write_report"]

NEES, DIMENSION = "nees.drawn", 3  # measure of a drive, and its degrees of freedom
FIRST = 6  # measures in front where a campaign states none
LISTED = 200  # failures that are listed
FOLDER = "report"  # of pictures, inside that of the campaign


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
    pictures = folder / FOLDER
    pictures.mkdir(exist_ok=True)
    blocks: list[Block] = [*_beginning(sheet), Heading("How episodes ended"), outcome_table(sheet)]
    measures = sheet.measures
    shown = [m for m in sheet.stated if m in sheet.values] or measures[:FIRST]
    if sheet.outcomes:
        blocks.append(_drawn(pictures / "outcomes.png", outcomes_picture(sheet), "share of episodes that succeeded"))
    blocks += [Heading("Measures"), Words(_of_whom(sheet))]
    for number, measure in enumerate(shown):
        blocks += [Words(f"{measure}:"), value_table(sheet, measure)]
        blocks.append(_drawn(pictures / f"measure-{number}.png", values_picture(sheet, measure), measure))
    rest = [m for m in measures if m not in shown]
    if rest:
        inner: list[Block] = []
        for measure in rest:
            inner += [Words(f"{measure}:"), value_table(sheet, measure)]
        blocks.append(Fold(f"{len(rest)} more measures", inner))
    blocks += consistency(sheet)
    blocks += differences(sheet, shown)
    if against is not None:
        blocks += _beside(sheet, load(against, any_code), shown)
    blocks += _failures(sheet)
    files = folder / "report.html", folder / "report.md"
    write_whole(files[0], as_html(sheet.title, blocks))
    write_whole(files[1], as_markdown(sheet.title, blocks, folder))
    return list(files)


def outcome_table(sheet: Sheet) -> Table:
    """How the episodes of every combination ended, and how often they succeed, with a 95 % interval (Wilson)."""
    rows = []
    for combination in sheet.outcomes:
        counts = sheet.counts(combination)
        low, high = share(counts[OK], counts.total())
        numbers = (str(counts.total()), *(str(counts[name]) for name in OUTCOMES))
        rows.append(
            (*combination, *numbers, f"{100 * counts[OK] / counts.total():.0f}", f"{100 * low:.0f} to {100 * high:.0f}")
        )
    return Table((*sheet.axes, "n", *OUTCOMES, "succeeded %", "95 % interval"), rows, len(sheet.axes))


def value_table(sheet: Sheet, measure: str) -> Table:
    """Number, mean, standard deviation, the same in per cent of the mean, a 95 % interval of the mean, extremes."""
    rows = []
    for combination in sheet.outcomes:
        values = sheet.column(measure, combination)
        rows.append((*combination, *_told(values)))
    head = (*sheet.axes, "n", "mean", "std", "std %", "95 % interval of the mean", "least", "greatest")
    return Table(head, rows, len(sheet.axes))


def consistency(sheet: Sheet) -> list[Block]:
    """Verdict on the covariances of the estimate, by the NEES of one tick drawn per drive; nothing without drives.

    Draws of different drives are independent, so their mean times their number is chi-squared with three degrees of
    freedom for each (Bar-Shalom et al. 2001, section 5.4).
    """
    drawn = np.array([value for found in sheet.values.get(NEES, {}).values() for value in found.values()])
    if not len(drawn):
        return []
    low, high = (float(2.0 * gammaincinv(0.5 * DIMENSION * len(drawn), p) / len(drawn)) for p in (0.025, 0.975))
    mean = float(drawn.mean())
    verdict = "too small" if mean > high else "too large" if mean < low else "consistent with the errors"
    return [
        Heading("Consistency of the estimate"),
        Words(
            f"Mean NEES of one tick drawn per drive, over {len(drawn)} drives: {mean:.2f}; {DIMENSION} is expected, "
            f"95 % band {low:.2f} to {high:.2f}. The covariances are {verdict}."
        ),
    ]


def differences(sheet: Sheet, measures: Sequence[str]) -> list[Block]:
    """Paired comparisons: every value of an axis with the first one, where seeds and all other axes are the same."""
    blocks: list[Block] = []
    for axis in sheet.compare:
        where, labels = list(sheet.axes).index(axis), sheet.axes[axis]
        if len(labels) < 2:
            continue
        found = []
        for measure in measures:
            for label in labels[1:]:
                pairs = _pairs(sheet, measure, where, labels[0], label)
                if len(pairs):
                    found.append((measure, f"{label} - {labels[0]}", pairs))
        if found:
            blocks += [Heading(f"{axis}: differences"), Words(_PAIRED.format(axis=axis)), _difference_table(found)]
    return blocks


_PAIRED = (
    "Pairs of episodes with the same seed that differ in {axis} alone. p: how likely a mean difference as large is "
    "when signs are by chance (sign-flip test); Holm: the same, corrected for the number of rows of this table."
)


def _beginning(sheet: Sheet) -> list[Block]:
    here = sum(len(seeds) for seeds in sheet.outcomes.values())
    words = f"{here} of {sheet.expected} episodes, {sheet.seconds / 3600:.2f} h of work, code `{sheet.code}`."
    if sheet.others:
        words += f" {sheet.others} rows of other states of the code are left out."
    if sheet.unreadable:
        words += f" {sheet.unreadable} lines of the file cannot be read."
    return [Words(words)]


def _of_whom(sheet: Sheet) -> str:
    whom = "episodes that succeeded" if sheet.succeeded_only else "all episodes that came to an end, failed ones too"
    return f"Of {whom}. n counts those whose measure is a finite number; intervals are by bootstrap."


def _told(values: Array) -> tuple[str, ...]:
    if not len(values):
        return ("0", *["-"] * 6)
    mean = float(values.mean())
    if len(values) == 1:
        return ("1", f"{mean:.5g}", "-", "-", "-", f"{mean:.5g}", f"{mean:.5g}")
    std, (low, high) = float(values.std(ddof=1)), interval(values)
    part = f"{100 * std / abs(mean):.2f}" if mean else "-"
    return (
        str(len(values)), f"{mean:.5g}", f"{std:.3g}", part, f"{low:.5g} to {high:.5g}", f"{values.min():.5g}",
        f"{values.max():.5g}",
    )  # fmt: skip


def _pairs(sheet: Sheet, measure: str, where: int, base: str, other: str) -> Array:
    """(n,) differences."""
    found = list[float]()
    for combination, mine in sheet.values[measure].items():
        if combination[where] == other:
            twin = (*combination[:where], base, *combination[where + 1 :])
            theirs = sheet.values[measure].get(twin, {})
            found += [mine[seed] - theirs[seed] for seed in mine.keys() & theirs.keys()]
    return np.sort(np.array(found))


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
    found, worst = [0.0] * len(chances), 0.0
    for rank, k in enumerate(order):
        worst = max(worst, min(1.0, (len(chances) - rank) * chances[k]))
        found[k] = worst
    return found


def _beside(sheet: Sheet, other: Sheet, measures: Sequence[str]) -> list[Block]:
    """Episodes of two campaigns that have the same labels and seeds."""
    blocks: list[Block] = [
        Heading(f"Against {other.folder}"),
        Words(f"There: code `{other.code}`. Differences are here - there, of episodes with the same labels and seed."),
    ]
    found = []
    for measure in measures:
        pairs = list[float]()
        for combination, mine in sheet.values[measure].items():
            theirs = other.values.get(measure, {}).get(combination, {})
            pairs += [mine[seed] - theirs[seed] for seed in mine.keys() & theirs.keys()]
        if pairs:
            found.append((measure, "here - there", np.sort(np.array(pairs))))
    if not found:
        return [*blocks, Words("No episode of one has the labels and seed of one of the other.")]
    blocks.append(_difference_table(found))
    turned = _turned(sheet, other)
    for words, folder, which in (
        ("ok there, not here", sheet, [pair for pair in turned if not pair[1]]),
        ("ok here, not there", other, [pair for pair in turned if pair[1]]),
    ):
        blocks.append(Words(f"{words}: {len(which)}."))
        if which:
            rows = [
                (*place[0], str(place[1]), replay_command(folder.folder, folder.keys[place]))
                for place, _ in which[:LISTED]
            ]
            blocks.append(Table((*sheet.axes, "seed", "command"), rows, len(sheet.axes) + 2))
    return blocks


def _turned(sheet: Sheet, other: Sheet) -> list[tuple[tuple[Combination, int | None], bool]]:
    """Episodes that are ok in one of two campaigns alone, and whether it is in the first."""
    found = []
    for combination, mine in sheet.outcomes.items():
        theirs = other.outcomes.get(combination, {})
        for seed in mine:
            if seed in theirs and (mine[seed] == OK) != (theirs[seed] == OK):
                found.append(((combination, seed), mine[seed] == OK))
    return found


def _failures(sheet: Sheet) -> list[Block]:
    failures = sheet.failures
    if not failures:
        return [Heading("Failures"), Words("None.")]
    rows = [
        (*f.combination, str(f.seed), f.outcome, f.why[:200], replay_command(sheet.folder, f.key))
        for f in failures[:LISTED]
    ]
    more = f" The first {LISTED} of {len(failures)}." if len(failures) > LISTED else ""
    return [
        Heading(f"{len(failures)} failures"),
        Words(f"Each with the command that runs it again, with scene and pictures.{more}"),
        Table((*sheet.axes, "seed", "outcome", "why", "command"), rows, len(sheet.axes) + 4),
    ]


def _drawn(path: Path, figure: object, words: str) -> Picture:
    return Picture(write_figure(path, figure, 110), words)  # type: ignore[arg-type]
