"""The way of a solve: cost, violation and steps over the iterations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import GREY, css
from unifg.style.figures import face, new_figure
from unifg.typing import Array, Axes, Figure

WIDE = 10.0  # ratio of the largest to the smallest cost from which on its axis is logarithmic
COLOURS = {"stationarity": "robot", "violation": "moving", "complementarity": "fixed", "step": "odometry"}
"""Name of a curve to the name of its colour."""


def draw_descent(cost: Array, errors: Mapping[str, Array]) -> Figure:
    """Cost above, and below it what has to become small, on a logarithmic axis.

    Args:
        cost: (k,) of every iterate.
        errors: curves (k,) by the names in COLOURS.

    Raises:
        ViewError: there is no iterate.
    """
    if not len(cost):
        raise ViewError("the history has no rows: there is nothing to plot")
    with new_figure((7.0, 5.2)) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        draw_cost(above, cost, f"Cost {cost[0]:.4g} at the start, {cost[-1]:.6g} at the end")
        draw_errors(below, errors)
        above.set_xlabel("")
        return figure


def draw_cost(ax: Axes, cost: Array, title: str) -> Axes:
    """Cost (k,) of every iterate, on a logarithmic axis where it falls far."""
    ax.plot(cost, color=css("robot"), lw=1.4, marker=".", ms=5.0)
    finite = cost[np.isfinite(cost)]
    if len(finite) and finite.min() > 0.0 and finite.max() > WIDE * finite.min():
        ax.set_yscale("log")
    _whole_numbers(ax)
    return face(ax, title, "cost", "iteration")


def draw_errors(ax: Axes, errors: Mapping[str, Array], tolerance: float | None = None) -> Axes:
    """Draw what has to become small, on a logarithmic axis.

    Args:
        ax: axes to draw into.
        errors: curves (k,) by the names in COLOURS; those that are zero throughout are left out.
        tolerance: of the test of convergence, as a dashed line.
    """
    drawn = 0
    for name, values in errors.items():
        shown = np.where((values > 0.0) & np.isfinite(values), values, np.nan)
        if np.isnan(shown).all():
            continue
        drawn += 1
        ax.plot(shown, color=css(COLOURS[name]), lw=1.2, marker=".", ms=4.0, label=name)
    if tolerance is not None:
        ax.axhline(tolerance, color=GREY, lw=0.9, ls="--", label="tolerance")
    if drawn:
        ax.set_yscale("log")
        ax.legend(loc="best", ncols=2)
    _whole_numbers(ax)
    return face(ax, "What is wrong with each iterate, and the steps", "", "iteration")


def _whole_numbers(ax: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
