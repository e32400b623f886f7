"""One look for all pictures: fonts, new figures and axes, the face and marks of axes, and the file a figure becomes.

Figures are made without matplotlib's global state (no ``pyplot``), so drawing works in threads and on machines without
a screen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from unifg.atomic_write import replacing
from unifg.errors import ViewError
from unifg.style.colours import GREY, INK
from unifg.typing import Array, ArrayLike, Axes, Figure

__all__ = [
    "dashes",
    "face",
    "ground",
    "headline",
    "key_of",
    "new_axes",
    "new_figure",
    "word",
    "write_figure",
]

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
        ViewError: there is no tick.
        ImportError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install "unifg[view]"') from error

    if ticks == 0:
        raise ViewError("there is no tick, and nothing to draw")
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        _spell(figure)


def _spell(figure: Figure) -> None:
    """Take dollars for dollars where they enclose no formula, as a name may hold what it likes."""
    from matplotlib.mathtext import MathTextParser
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if text.get_text().count("$") > 1:
            try:
                MathTextParser("agg").parse(text.get_text())
            except ValueError:
                text.set_parse_math(False)


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


def face(ax: Axes, title: str, y: str = "", x: str = "") -> Axes:
    """Title, labels and grid."""
    ax.set_title(title)
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.set_axisbelow(True)
    ax.grid(True)
    return ax


def dashes(ax: Axes, levels: Iterable[float], width: float = 1.0) -> None:
    """Dashed lines across, for limits and quantiles."""
    for level in levels:
        ax.axhline(level, color=GREY, lw=width, ls="--")


def ground(ax: Axes, low: ArrayLike, high: ArrayLike) -> None:
    """Equal axes in metres between two corners (2,) [m]."""
    (left, bottom), (right, top) = np.asarray(low).tolist(), np.asarray(high).tolist()
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")


def word(ax: Axes, at: Array, text: str, offset: tuple[int, int], **style: Any) -> None:
    """A word beside a place."""
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
    ax.annotate(
        text, (float(at[0]), float(at[1])), xytext=offset, textcoords="offset points",
        **{"ha": "center", "va": "center", "fontsize": 9, "fontweight": "bold", "zorder": 11, "bbox": box, **style},
    )  # fmt: skip


def write_figure(path: str | Path, figure: Figure, dpi: int) -> Path:
    """Write a figure as a PNG and return its path; the same log gives the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    path = Path(path)
    figure.set_dpi(dpi)
    with replacing(path) as own:  # `savefig` would draw everything twice; no version, no date
        FigureCanvasAgg(figure).print_png(own, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return path
