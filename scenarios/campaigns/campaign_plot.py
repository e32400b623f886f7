"""Pictures of campaigns: every episode as a point, by combination of the axes."""

from __future__ import annotations

import numpy as np

from unifg.scenarios.campaigns.comparison import interval, share
from unifg.scenarios.campaigns.sheet import Combination, Sheet
from unifg.scenarios.campaigns.task import OK
from unifg.style.colours import INK, css
from unifg.style.figures import face, new_figure
from unifg.typing import Axes, Figure

__all__ = ["outcomes_picture", "values_picture"]

_WIDE, _LINE, _REST = 9.0, 0.3, 1.1  # [inch]: width, height of a line, and of what stands around them
_LONGEST = 60  # lines of a picture; beyond that they cannot be read


def outcomes_picture(sheet: Sheet) -> Figure:
    """The share of episodes that succeeded, with its 95 % interval (Wilson)."""
    shown = sheet.combinations[:_LONGEST]
    with new_figure((_WIDE, _REST + _LINE * len(shown)), len(shown)) as figure:
        ax = figure.subplots()
        for line, combination in enumerate(shown):
            counts = sheet.counts(combination)
            low, high = share(counts[OK], counts.total())
            ax.plot([low, high], [line, line], color=css("trail"), lw=5.0, alpha=0.35, solid_capstyle="butt")
            ax.plot([counts[OK] / counts.total()], [line], "o", color=css("robot"), ms=6.0)
            ax.text(1.04, line, f"{counts[OK]} / {counts.total()}", va="center", fontsize=8.0, color=INK)
        face(ax, "Episodes that succeeded", x="share, with its 95 % interval")
        ax.set_xlim(-0.02, 1.02)
        _lines(ax, shown)
    return figure


def values_picture(sheet: Sheet, measure: str) -> Figure:
    """Every episode, and the mean with its 95 % interval."""
    shown = [c for c in sheet.combinations if len(sheet.column(measure, c))][:_LONGEST]
    with new_figure((_WIDE, _REST + _LINE * max(1, len(shown))), max(1, len(shown))) as figure:
        ax = figure.subplots()
        rng = np.random.default_rng(0)
        for line, combination in enumerate(shown):
            values = sheet.column(measure, combination)
            beside = line + rng.uniform(-0.22, 0.22, len(values))
            ax.plot(values, beside, "o", color=css("trail"), ms=4.5, alpha=0.6, mew=0.0)
            if len(values) > 1:
                ax.plot(interval(values), [line, line], color=css("robot"), lw=2.5)
            ax.plot([values.mean()], [line], "|", color=css("robot"), ms=12.0, mew=2.0)
        face(ax, measure, x="every episode; mean with its 95 % interval")
        _lines(ax, shown)
    return figure


def _lines(ax: Axes, shown: list[Combination]) -> None:
    """Name the lines, the first on top."""
    ax.set_yticks(range(len(shown)), [", ".join(c)[:70] or "all" for c in shown])
    ax.set_ylim(len(shown) - 0.5, -0.5)
    ax.grid(False, axis="y")
