"""Residual of every factor at every iteration of a solve, as one picture.

One panel per term, factors upwards, iterations to the right, the residual norm as a colour. FactorMPC (Yang et al.
2025) monitors its factors in this way. :class:`ResidualMonitor` draws while the solver goes on,
:func:`residual_picture` afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from unifg.errors import UnifgError
from unifg.solution.history import Iteration
from unifg.style.figures import new_figure, write_figure
from unifg.typing import Array, Axes, Figure

__all__ = ["ResidualMonitor", "plot_residuals", "residual_picture"]

_DECADES = 8.0  # below the largest residual of a term; what is smaller has the darkest colour
_PANEL = (3.6, 2.6)  # width and height of a panel [inch]
_ACROSS = 3  # panels side by side


class ResidualMonitor:
    """A callback that keeps the residuals of every factor and, where it is given a file, draws them at each iteration.

    ``solver.solve(graph, guess, callback=ResidualMonitor(path="live.png"))``; a viewer that follows the file shows the
    solve as it goes on.

    Attributes:
        rows: (n,) norms of every factor by term, one mapping per iteration.
    """

    def __init__(self, terms: Sequence[str] | None = None, path: str | Path | None = None, *, dpi: int = 100) -> None:
        """Watch some terms, or all.

        Args:
            terms: names; None for all terms of the graph.
            path: PNG file that is rewritten at each iteration; None to draw nothing until :meth:`figure`.
            dpi: dots per inch of that file.
        """
        self.rows: list[Mapping[str, Array]] = []
        self._terms, self._dpi = terms, dpi
        self._path = None if path is None else Path(path)

    def __call__(self, row: Iteration) -> bool:
        """Take in a row of the history; never ends the solve."""
        self.rows.append(row.residuals)
        if self._path is not None:
            write_figure(self._path, self.figure(), self._dpi)
        return False

    def figure(self) -> Figure:
        """The picture of what has been seen so far."""
        return _drawn(self.rows, self._terms)


def residual_picture(history: Sequence[Iteration], terms: Sequence[str] | None = None) -> Figure:
    """Draw the residual of every factor over the iterations of a solve with ``keep_residuals=True``.

    Args:
        history: of the solution.
        terms: names; None for all terms of the graph.

    Returns:
        A figure with one panel per term.

    Raises:
        GraphError: when no term has one of these names.
        UnifgError: when the residuals were not kept, or there is no row.
    """
    return _drawn([row.residuals for row in history], terms)


def plot_residuals(rows: Sequence[Mapping[str, Array]], term: str, ax: Axes) -> Axes:
    """Draw one term into axes of your own.

    Args:
        rows: norms by term for every iteration, as ``[row.residuals for row in history]``.
        term: its name.
        ax: axes to draw into.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FixedLocator, MaxNLocator

    table = np.stack([row[term] for row in rows], axis=1)
    top = float(table.max(initial=0.0)) or 1.0
    bottom = max(top * 10.0**-_DECADES, float(np.finfo(np.float64).tiny))
    image = ax.imshow(
        np.maximum(table, bottom),
        norm=LogNorm(bottom, top),
        aspect="auto",
        origin="lower",
        interpolation="nearest",
        cmap="magma",
    )
    ax.figure.colorbar(image, ax=ax, pad=0.02)
    count = len(table)
    ax.set_title(f"{term}: {count} factor{'' if count == 1 else 's'}", loc="left")
    ax.set_xlabel("iteration")
    ax.set_ylabel("factor")
    ax.tick_params(labelsize=7.0)
    for axis, length in ((ax.xaxis, table.shape[1]), (ax.yaxis, count)):
        axis.set_major_locator(MaxNLocator(min(6, length), integer=True) if length > 1 else FixedLocator([0]))
    return ax


def _drawn(rows: Sequence[Mapping[str, Array]], terms: Sequence[str] | None) -> Figure:
    if not rows:
        raise UnifgError("there is no iteration to draw: solve first")
    names = list(rows[0]) if terms is None else list(terms)
    across = min(_ACROSS, len(names))
    down = -(-len(names) // across)
    with new_figure((_PANEL[0] * across, _PANEL[1] * down)) as figure:
        for place, name in enumerate(names, start=1):
            plot_residuals(rows, name, figure.add_subplot(down, across, place))
    return figure
