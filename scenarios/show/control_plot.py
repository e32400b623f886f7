"""How a flight was controlled: controls against their limits, clearance, and time spent on each tick.

Limits are drawn where the settings of the flight name them, at their top or under ``controller``: ``rate_limits``,
three greatest rates [rad/s], and ``thrust_limits``, least and greatest thrust [N]. Each function draws into the axes it
is given, or into new ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.show.style import GREY, css, finish, heading, new_figure, over_time, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["control", "plot_clearance", "plot_control", "plot_height", "plot_speed", "plot_tick_times", "write_control"]

_CONTROLS = ("Roll rate", "Pitch rate", "Yaw rate", "Thrust")


def write_control(path: str | Path, log: FlightLog, *, dpi: int = 120) -> Path:
    """Write controls, clearance and timing of a flight as a PNG.

    Args:
        path: file to write; an existing one is replaced.
        log: a flight of at least one tick.
        dpi: dots per inch of a figure 15 inches wide.

    Returns:
        The path written.

    Raises:
        ScenarioError: the flight has no tick.
    """
    return write_figure(path, control(log), dpi)


def control(log: FlightLog) -> Figure:
    """Body rates and thrust on the left; speed and height, clearance and timing on the right.

    Args:
        log: a flight of at least one tick.

    Raises:
        ScenarioError: the flight has no tick.
    """
    clock = float((log.estimate_ms + log.plan_ms).max()) > 0.0 if log.ticks else False
    with new_figure(log, (15.0, 9.2)) as figure:
        left, right = figure.subfigures(1, 2, squeeze=False)[0]
        panels = left.subplots(4, 1, sharex=True)
        for index, ax in enumerate(panels):
            plot_control(log, index, ax=ax)
        others = right.subplots(4 if clock else 3, 1, sharex=True)
        plot_speed(log, ax=others[0])
        plot_height(log, ax=others[1])
        plot_clearance(log, ax=others[2])
        if clock:
            plot_tick_times(log, ax=others[3])
        for part, axes in ((left, panels), (right, others)):
            axes[-1].set_xlabel("time [s]")
            part.align_ylabels(axes)
        stored = int(log.emergency.sum())
        what = "How it was flown" + (f" (grey: {stored} ticks of a stored plan)" if stored else "")
        heading(log, figure, what)
    return figure


def plot_control(log: FlightLog, index: int, ax: Axes | None = None) -> Axes:
    """One control over time against its limits.

    Args:
        log: the flight.
        index: 0-2 body rates, 3 thrust.
        ax: axes to draw into; None for new ones.
    """
    ax = over_time(ax)
    values = log.controls[:, index]
    ax.step(log.time, values, where="post", color=css("robot"), lw=1.2)
    limits = _limits(log, index)
    shown = [float(values.min()), float(values.max())]
    for limit in limits:
        ax.axhline(limit, color=GREY, lw=1.1, ls="--")
    shown += limits
    margin = 0.08 * max(max(shown) - min(shown), 0.1)
    ax.set_ylim(min(shown) - margin, max(shown) + margin)
    ax.set_ylabel("[N]" if index == 3 else "[rad/s]")
    ax.set_title(_CONTROLS[index] + (" and its limits" if limits else ""))
    return finish(log, ax)


def plot_speed(log: FlightLog, ax: Axes | None = None) -> Axes:
    """True speed over time [m/s]."""
    ax = over_time(ax)
    speed = np.linalg.norm(log.truth[:, 7:], axis=1)
    ax.plot(log.time, speed, color=css("robot"), lw=1.4)
    ax.set_ylim(0.0, 1.12 * max(float(speed.max()), 0.1))
    ax.set_ylabel("[m/s]")
    ax.set_title(f"Speed, at most {speed.max():.2f} m/s")
    return finish(log, ax)


def plot_height(log: FlightLog, ax: Axes | None = None) -> Axes:
    """True height over time, with that of the target [m]."""
    ax = over_time(ax)
    ax.plot(log.time, log.truth[:, 2], color=css("robot"), lw=1.4)
    ax.axhline(float(log.layout.target[2]), color=css("goal"), lw=1.4, ls="--")
    ax.set_ylim(0.0, 1.15 * max(float(log.truth[:, 2].max()), float(log.layout.target[2]), 0.1))
    ax.set_ylabel("[m]")
    ax.set_title("Height, and that of the target")
    return finish(log, ax)


def plot_clearance(log: FlightLog, ax: Axes | None = None) -> Axes:
    """Distance from the hull to the nearest thing or the floor over time [m]."""
    ax = over_time(ax)
    ax.fill_between(log.time, log.clearance, color=css("horizon"), alpha=0.18, lw=0)
    ax.plot(log.time, log.clearance, color=css("horizon"), lw=1.2)
    ax.axhline(0.0, color=css("moving"), lw=1.2)
    lowest = int(np.argmin(log.clearance))
    least = float(log.clearance[lowest])
    ax.plot(log.time[lowest], least, "v", color=css("horizon"), ms=6)
    finite = log.clearance[np.isfinite(log.clearance)]
    top = 1.15 * max(float(finite.max()), 0.05) if finite.size else 1.0
    ax.set_ylim(min(0.0, 1.1 * least if np.isfinite(least) else 0.0) - 0.03 * top, top)
    ax.set_ylabel("[m]")
    ax.set_title(f"Clearance between hull and nearest thing, at least {max(0.0, least):.2f} m")
    return finish(log, ax)


def plot_tick_times(log: FlightLog, ax: Axes | None = None) -> Axes:
    """Time spent on estimation and on planning in each tick [ms]; the axis is logarithmic."""
    ax = over_time(ax)
    total = log.estimate_ms + log.plan_ms
    for name, values, colour, size in (
        ("both", total, css("plan"), 4.0),
        ("plan", log.plan_ms, css("horizon"), 2.6),
        ("estimate", log.estimate_ms, css("estimate"), 2.6),
    ):
        if (values > 0.0).any():
            ax.plot(log.time, np.where(values > 0.0, values, np.nan), ".", color=colour, ms=size, label=name)
    p50, p99 = np.percentile(total, [50.0, 99.0])
    ax.axhline(1e3 * log.dt, color=css("moving"), lw=1.1, label="control period")
    for value in (p50, p99):
        ax.axhline(value, color=GREY, lw=0.9, ls="--")
    ax.set_yscale("log")
    ax.set_ylabel("[ms]")
    ax.set_title(f"Time per tick: median {p50:.1f} ms, 99 % within {p99:.0f} ms")
    ax.legend(loc="upper right", ncols=4, markerscale=3, borderpad=0.0)
    return finish(log, ax)


def _limits(log: FlightLog, index: int) -> list[float]:
    settings = {**log.settings, **log.settings.get("controller", {})}
    if index == 3:
        return [float(limit) for limit in settings.get("thrust_limits", ())]
    rates = settings.get("rate_limits", ())
    return [-float(rates[index]), float(rates[index])] if len(rates) == 3 else []
