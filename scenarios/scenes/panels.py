"""Panels and marks that several pictures share; a panel draws into the given axes and returns them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from unifg.style.colours import GREY, css
from unifg.style.figures import dashes, face
from unifg.typing import Array, ArrayLike, Axes

__all__ = [
    "over_time",
    "padded",
    "plot_clearance",
    "plot_held",
    "plot_times",
    "shade",
    "shade_distance",
    "shade_trouble",
    "timed_way",
]


def over_time(
    log: Any,
    ax: Axes,
    title: str,
    y: str,
    curves: Iterable[tuple[Array, Mapping[str, Any]]] = (),
    *,
    levels: Iterable[float] = (),
    bounds: tuple[float, float] | None = None,
) -> Axes:
    """Draw curves over the time of a run, shaded where a stored plan was followed.

    Args:
        log: with ticks, time, dt, and an emergency flag for each tick.
        ax: axes to draw into.
        title: of the panel.
        y: label of the axis.
        curves: values (T,) of every tick, and the style of the line.
        levels: of dashed lines.
        bounds: lower and upper end of the axis; None for those that matplotlib finds.
    """
    dashes(ax, levels)
    for values, style in curves:
        ax.plot(log.time, values, **{"lw": 1.2, **style})
    ax.set_xlim(0.0, log.ticks * log.dt)
    ax.set_ylim(*(bounds or ax.get_ylim()))
    shade(ax, log.emergency, log.dt, "#000000", 0.12)
    return face(ax, title, y)


def timed_way(ax: Axes, way: Array, time: Array, name: str) -> None:
    """Draw a way (n, 2) [m] in the colours of its times (n,) [s], with a bar: pacing shows."""
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap

    shades = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.92, 256)))  # without the yellow, pale on a floor
    steps = list(np.stack([way[:-1], way[1:]], axis=1))
    line = LineCollection(steps, array=time[1:], cmap=shades, linewidths=2.6, capstyle="round", zorder=9)
    ax.add_collection(line, autolim=False)
    ax.figure.colorbar(line, ax=ax, shrink=0.6, pad=0.01, label=f"{name} [s]")


def padded(*values: ArrayLike, share: float = 0.08, least: float = 1e-9) -> tuple[float, float]:
    """Ends of an axis around all values, with a margin of a share of their range, or of ``least``."""
    every = np.concatenate([np.ravel(part) for part in values])
    low, high = float(every.min()), float(every.max())
    margin = share * max(high - low, least)
    return low - margin, high + margin


def shade(ax: Axes, flags: Array, dt: float, colour: str, alpha: float) -> None:
    """Shade the ticks of ``dt`` [s] that are flagged."""
    steps = np.diff(np.concatenate([[0], np.asarray(flags).astype(np.int8), [0]]))
    for begin, end in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        ax.axvspan(begin * dt, end * dt, color=colour, alpha=alpha, lw=0)


def plot_held(
    ax: Axes, time: Array, values: Array, limits: tuple[float, float] | None, title: str, label: str, name: str
) -> Axes:
    """Draw a control that is held between nodes; what lies beyond its limits is shaded.

    Args:
        ax: axes to draw into.
        time: (n + 1,) of the nodes [s].
        values: (n,) held from each node to the next.
        limits: least and greatest value; None without any.
        title: of the panel.
        label: of its axis.
        name: of the curve, for a legend.
    """
    bottom, top = padded(0.0, values, limits or (), share=0.15)
    ax.axhline(0.0, color=GREY, lw=0.8)
    for limit, end in zip(limits or (), (bottom, top), strict=False):
        ax.axhspan(min(limit, end), max(limit, end), color=GREY, alpha=0.22, lw=0)
        ax.text(time[-1], 0.5 * (limit + end), "not allowed ", ha="right", va="center", fontsize=8, color="#4b5563")
    ax.step(time, np.append(values, values[-1]), where="post", color=css("robot"), lw=1.6, label=name)
    ax.set_ylim(bottom, top)
    ax.set_xlim(0.0, time[-1])
    return face(ax, title, label)


def shade_trouble(ax: Axes, dt: float, health: Sequence[str], causes: Sequence[str], what: str) -> None:
    """Shade the time in which a robot could not rely on everything; the title says what was the matter longest.

    Args:
        ax: axes over time.
        dt: duration of a tick [s].
        health: "ok", "degraded" or "lost" for every tick.
        causes: why it was not well, "" where it was.
        what: is drawn, for the title.
    """
    for state, colour in (("degraded", "moving"), ("lost", "robot")):
        shade(ax, np.array(health) == state, dt, css(colour), 0.18)
    named = Counter(cause for cause in causes if cause)
    if named:
        states = " and ".join(state for state in ("degraded", "lost") if state in health)
        ax.set_title(fill(f"{what}; {states}: {named.most_common(1)[0][0]}", 72), fontsize=8)


def plot_clearance(log: Any, ax: Axes) -> Axes:
    """Distance from the hull to the nearest thing over time [m]."""
    lowest = int(np.argmin(log.clearance))
    least = float(log.clearance[lowest])
    finite = log.clearance[np.isfinite(log.clearance)]
    top = 1.15 * max(float(finite.max()), 0.05) if finite.size else 1.0
    bounds = min(0.0, 1.1 * least if np.isfinite(least) else 0.0) - 0.03 * top, top
    title = f"Clearance between hull and nearest thing, at least {max(0.0, least):.2f} m"
    ax = over_time(log, ax, title, "clearance [m]", [(log.clearance, {"color": css("horizon")})], bounds=bounds)
    ax.fill_between(log.time, log.clearance, color=css("horizon"), alpha=0.18, lw=0)
    ax.axhline(0.0, color=css("moving"), lw=1.2)
    ax.plot(log.time[lowest], least, "v", color=css("horizon"), ms=6)
    return ax


def plot_times(log: Any, total: Array, parts: Mapping[str, tuple[Array, str]], ax: Axes) -> Axes:
    """Time spent in each tick, in all and on each part [ms], on a logarithmic axis.

    Ticks in which something was compiled, or read from the disk, are marked: their time is not that of the others.

    Args:
        log: the run.
        total: (T,) [ms].
        parts: names to (T,) [ms] and colour.
        ax: axes to draw into.
    """
    for name, (values, colour) in {"all": (total, "plan"), **parts}.items():
        if (values > 0.0).any():
            spent = np.where(values > 0.0, values, np.nan)
            ax.plot(log.time, spent, ".", color=css(colour), ms=3.6 if values is total else 2.4, label=name)
    new = (log.compiled > 0) & (total > 0.0)
    if new.any():
        ax.plot(log.time[new], total[new], "o", mfc="none", mec=css("moving"), ms=5.0, label="compiled")
    p50, p99 = np.percentile(total, [50.0, 99.0])
    dashes(ax, (p50, p99), 0.9)
    ax.set_yscale("log")
    spent = np.concatenate([values[values > 0.0] for values in (total, *(values for values, _ in parts.values()))])
    if len(spent):  # a first tick, which has nothing to do yet, would leave decades empty
        ax.set_ylim(bottom=0.5 * float(np.percentile(spent, 1.0)))
    ax.legend(loc="upper right", ncols=4, markerscale=3, borderpad=0.0)
    return over_time(log, ax, f"Time per tick: median {p50:.1f} ms, 99 % within {p99:.0f} ms", "time [ms]")


def shade_distance(
    ax: Axes, low: Array, high: Array, distance: Callable[[Array], Array], reach: float, dark: str
) -> tuple[Array, Array, Array]:
    """Shade the ground, the darker the nearer something is.

    Args:
        ax: axes to draw into.
        low: (2,) lower left corner [m].
        high: (2,) upper right corner [m].
        distance: of points (n, 2) [m].
        reach: how far the shading goes [m].
        dark: colour of distance zero.

    Returns:
        x (240,), y (160,) and distances (160, 240) [m].
    """
    from matplotlib.colors import LinearSegmentedColormap

    x, y = np.linspace(low[0], high[0], 240), np.linspace(low[1], high[1], 160)
    gap = distance(np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)).reshape(len(y), len(x))
    colours = LinearSegmentedColormap.from_list("near", [dark, "#ffffff"])
    ax.contourf(x, y, np.clip(gap, 0.0, reach), levels=np.linspace(0.0, reach, 9), cmap=colours, zorder=0)
    return x, y, gap
