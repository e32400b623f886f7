"""One look for all pictures: colours, fonts, new figures and axes, and the file a figure becomes.

One colour stands for one thing, in scenes and plots alike; chosen from colour-blind-safe sets (Okabe and Ito 2008).
Figures are made without matplotlib's global state (no ``pyplot``), so drawing works in threads and on machines without
a screen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unifg.errors import ScenarioError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "GREY", "INK", "css", "headline", "key_of", "new_axes", "new_figure", "write_figure"]

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


def css(name: str) -> str:
    """The colour as ``#rrggbb``."""
    return f"#{COLOURS[name]:06x}"


INK, GREY = css("ink"), "#6b7280"
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
    "axes.axisbelow": True,
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "grid.color": "#e3e6ea",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


@contextmanager
def new_figure(size: tuple[float, float], ticks: int = 1) -> Iterator[Figure]:
    """A figure in the style of the house, of that size [inch]; everything is to be drawn before the block ends.

    Args:
        size: width and height [inch].
        ticks: of the run to be drawn.

    Raises:
        ScenarioError: there is no tick.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if ticks == 0:
        raise ScenarioError("there is no tick, and nothing to draw")
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def new_axes(ax: Axes | None) -> Axes:
    """The axes given, or new ones."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    return Figure(layout="constrained").subplots()


def headline(figure: Figure, text: str, size: float = 12.5) -> None:
    """Write the title of a figure."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=size, fontweight="bold")


def key_of(axes: Iterable[Axes]) -> tuple[list[Any], list[str]]:
    """Handles and labels of one legend for several axes, each label once."""
    named: dict[str, Any] = {}
    for ax in axes:
        handles, labels = ax.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    return list(named.values()), list(named)


def write_figure(path: str | Path, figure: Figure, dpi: int) -> Path:
    """Write a figure as a PNG and return its path; the same log gives the same bytes."""
    path = Path(path)
    figure.savefig(path, dpi=dpi, format="png", metadata={"Software": None})  # no version, no date
    return path
