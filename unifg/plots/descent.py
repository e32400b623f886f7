"""The way of a solve: cost, violation and steps over the iterations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import css
from unifg.style.figures import face, new_figure
from unifg.typing import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE = 10.0  # ratio of the largest to the smallest cost from which on its axis is logarithmic
COLOURS = {"stationarity": "robot", "violation": "moving", "complementarity": "fixed", "step": "odometry"}
"""Name of a curve to the name of its colour."""


def draw_descent(cost: Array, errors: Mapping[str, Array], title: str = "") -> Figure:
    """Cost above, and below it what has to become small, on a logarithmic axis.

    Args:
        cost: (k,) of every iterate.
        errors: curves (k,) by the names in COLOURS; those that are zero throughout are left out.
        title: of the upper panel.

    Raises:
        ViewError: there is no iterate.
    """
    if not len(cost):
        raise ViewError("the history has no rows: there is nothing to plot")
    with new_figure((7.0, 5.2)) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        number = np.arange(len(cost))
        above.plot(number, cost, color=css("robot"), lw=1.4, marker=".", ms=5.0)
        finite = cost[np.isfinite(cost)]
        if len(finite) and finite.min() > 0.0 and finite.max() > WIDE * finite.min():
            above.set_yscale("log")
        face(above, title or f"Cost {cost[0]:.4g} at the start, {cost[-1]:.6g} at the end", "cost")
        _draw_errors(below, number, errors)
        return figure


def _draw_errors(ax: Axes, number: IntArray, errors: Mapping[str, Array]) -> None:
    from matplotlib.ticker import MaxNLocator

    drawn = 0
    for name, values in errors.items():
        shown = np.where((values > 0.0) & np.isfinite(values), values, np.nan)
        if np.isnan(shown).all():
            continue
        drawn += 1
        ax.plot(number, shown, color=css(COLOURS[name]), lw=1.2, marker=".", ms=4.0, label=name)
    face(ax, "What is wrong with each iterate, and the steps", "", "iteration")
    if drawn:
        ax.set_yscale("log")
        ax.legend(loc="best", ncols=2)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
