"""What all pictures share: colours, style, new figures and axes over time, and the file they become.

One colour stands for one thing, in scenes and plots alike; chosen from colour-blind-safe sets (Okabe and Ito 2008).
Figures are made without matplotlib's global state (no ``pyplot``), so drawing works in threads and on machines without
a screen.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.log.flight_log import FlightLog

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "GREY", "INK", "css", "finish", "heading", "new_figure", "over_time", "write_figure"]

COLOURS = {
    "floor": 0xF6F4EF,
    "metres": 0xE2DFD6,
    "wall": 0x9AA3AE,
    "ink": 0x1D2430,
    "dark": 0x2B3340,
    "plan": 0x4D4D4D,
    "start": 0x4D4D4D,
    "goal": 0xF0C000,
    "pole": 0x4D4D4D,
    "robot": 0x0A56A8,
    "heading": 0xFFFFFF,
    "trail": 0x3D95E0,
    "estimate": 0x8A3FD0,
    "odometry": 0x7F7F7F,
    "horizon": 0x009E4F,
    "scan": 0xE6007E,
    "fixed": 0xF09000,
    "moving": 0xD62718,
    "detected": 0x000000,
    "closure": 0x009E4F,
    "outlier": 0xD62718,
    "landmark": 0xF09000,
}
"""Name to 0xRRGGBB."""

INK, GREY = "#1d2430", "#6b7280"
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # ships with matplotlib: the same picture everywhere
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a919c",
    "axes.labelcolor": INK,
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "grid.color": "#e3e6ea",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def css(name: str) -> str:
    """The colour as ``#rrggbb``."""
    return f"#{COLOURS[name]:06x}"


@contextmanager
def new_figure(log: FlightLog, size: tuple[float, float]) -> Iterator[Figure]:
    """A figure in the style of the house, of that size [inch]; everything is to be drawn before the block ends.

    Raises:
        ScenarioError: the flight has no tick.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if log.ticks == 0:
        raise ScenarioError("the flight has no tick: there is nothing to draw")
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def over_time(ax: Axes | None) -> Axes:
    """The axes given, or new ones."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    return Figure(layout="constrained").subplots()


def finish(log: FlightLog, ax: Axes) -> Axes:
    """Grid, the span of the flight, and shading over ticks that flew a stored plan."""
    ax.set_axisbelow(True)
    ax.grid(True)
    ax.set_xlim(0.0, log.ticks * log.dt)
    steps = np.diff(np.concatenate([[0], log.emergency.astype(np.int8), [0]]))
    for begin, end in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        ax.axvspan(begin * log.dt, end * log.dt, color="#000000", alpha=0.12, lw=0)
    return ax


def heading(log: FlightLog, figure: Figure, what: str) -> None:
    """Title of a figure: what it shows and of which flight."""
    settings = log.settings
    words = [what, str(settings.get("scenario", "")), log.layout.name]
    if settings.get("solver"):
        coupling = f" ({settings['coupling']})" if settings.get("coupling") else ""
        words.append(f"solver {settings['solver']}{coupling}")
    if settings.get("seed") is not None:
        words.append(f"seed {settings['seed']}")
    figure.suptitle("  |  ".join(word for word in words if word), x=0.01, ha="left", fontsize=12.5, fontweight="bold")


def write_figure(path: str | Path, figure: Figure, dpi: int) -> Path:
    """Write a figure as a PNG and return its path; the same log gives the same bytes."""
    path = Path(path)
    figure.savefig(path, dpi=dpi, format="png", metadata={"Software": None})  # no version, no date
    return path
