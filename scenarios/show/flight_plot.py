"""A flight from above at several moments, as in Fig. 5 of Ta, Kobilarov and Dellaert (ICUAS 2014).

The estimated past is blue, the predicted future green, the reach of the sensor magenta; cylinders seen by then are
filled, others hollow. Each function draws into the axes it is given, or into new ones.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import has_estimate
from unifg.scenarios.show.flight_scene import SIGMAS, first_sights, sensor_reach
from unifg.scenarios.show.shapes import ellipse_axes
from unifg.scenarios.show.style import GREY, INK, css, heading, new_figure, over_time, write_figure
from unifg.scenarios.worlds.air import VEHICLE_RADIUS
from unifg.typing import IntArray

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["moments", "overview", "plot_moment", "write_overview"]

_MARGIN = 0.6  # around the layout [m]
_WIDE = 2.0  # layouts at least this many times as long as wide are drawn in two columns, others in three


def write_overview(path: str | Path, log: FlightLog, *, dpi: int = 130) -> Path:
    """Write the flight from above as a PNG.

    Args:
        path: file to write; an existing one is replaced.
        log: a flight of at least one tick.
        dpi: dots per inch of a figure 15 inches wide.

    Returns:
        The path written.

    Raises:
        ScenarioError: the flight has no tick.
    """
    return write_figure(path, overview(log), dpi)


def overview(log: FlightLog) -> Figure:
    """Six moments, evenly spread from the first tick to the last.

    Args:
        log: a flight of at least one tick.

    Raises:
        ScenarioError: the flight has no tick.
    """
    width, height = np.ptp(log.layout.size, axis=0) + 2.0 * _MARGIN
    columns = 2 if width >= _WIDE * height else 3
    shown = moments(log)
    rows = math.ceil(len(shown) / columns)
    panel = 14.4 / columns
    with new_figure(log, (15.0, rows * (panel * height / width + 0.42) + 1.1)) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        panels = list(grid.flat)
        for ax, tick in zip(panels, shown.tolist(), strict=False):
            plot_moment(log, tick, ax=ax, legend=False)
        for ax in panels[len(shown) :]:
            ax.set_axis_off()
        for ax in grid[-1]:
            ax.set_xlabel("x [m]")
        for ax in grid[:, 0]:
            ax.set_ylabel("y [m]")
        named: dict[str, Artist] = {}
        for ax in panels:
            handles, labels = ax.get_legend_handles_labels()
            named |= dict(zip(labels, handles, strict=True))
        figure.legend(list(named.values()), list(named), loc="outside lower center", ncols=6)
        hits = "no collision" if log.collisions == 0 else f"{log.collisions} collision" + "s" * (log.collisions > 1)
        reached = "target reached" if log.reached else "target not reached"
        heading(log, figure, f"{reached}, {hits}")
    return figure


def moments(log: FlightLog, count: int = 6) -> IntArray:
    """At most that many ticks, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, log.ticks - 1, count).round().astype(np.intp))


def plot_moment(log: FlightLog, tick: int, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """What stood there, was believed and meant at one tick, from above.

    Args:
        log: the flight.
        tick: which.
        ax: axes to draw into; None for new ones.
        legend: False leaves out the legend below the axes.
    """
    from matplotlib.patches import Circle

    ax = over_time(ax)
    _things(log, tick, ax)
    estimated = has_estimate(log)
    way = log.believed[: tick + 1, :2].T
    if estimated:
        ax.plot(*log.truth[: tick + 1, :2].T, color=css("odometry"), lw=0.9, label="true way", zorder=4)
    name = "estimated past" if estimated else "way flown"
    ax.plot(*way, color=css("trail"), lw=1.6, label=name, zorder=5)
    past = log.pasts[tick]
    if len(past) > 1:
        ax.plot(*past[:, :2].T, color=css("robot"), lw=2.6, label="its window that is smoothed", zorder=6)
    plan = log.plans[tick]
    if len(plan) > 1 and np.isfinite(plan).all():
        ax.plot(*plan[:, :2].T, color=css("horizon"), lw=2.6, label="predicted future", zorder=7)
    _landmarks(log, tick, ax)
    x, y = log.truth[tick, :2].tolist()
    reach = sensor_reach(log)
    if reach is not None:
        circle = Circle((x, y), reach, fill=False, edgecolor=css("scan"), lw=1.3, zorder=3, label="reach of the sensor")
        ax.add_patch(circle)
    ax.add_patch(Circle((x, y), VEHICLE_RADIUS, facecolor=css("robot"), edgecolor="white", lw=0.6, zorder=9))
    ax.plot(*log.layout.start[:2], "o", color=css("start"), ms=4, zorder=8, label="start")
    ax.plot(
        *log.layout.target[:2], "*", color=css("goal"), ms=13, mec=INK, mew=0.7, zorder=10, label="target",
        ls="none",
    )  # fmt: skip

    low, high = log.layout.size
    ax.set_xlim(low[0] - _MARGIN, high[0] + _MARGIN)
    ax.set_ylim(low[1] - _MARGIN, high[1] + _MARGIN)
    ax.set_aspect("equal")
    speed = float(np.linalg.norm(log.truth[tick, 7:]))
    stored = ", stored plan flown" if log.emergency[tick] else ""
    ax.set_title(f"{log.time[tick]:.1f} s, {speed:.1f} m/s, height {log.truth[tick, 2]:.1f} m{stored}")
    if legend:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4)
    return ax


def _things(log: FlightLog, tick: int, ax: Axes) -> None:
    """Walls, cylinders and movers."""
    from matplotlib.patches import Circle

    for index, wall in enumerate(log.layout.walls):
        ax.plot(*wall.T, color=css("wall"), lw=3.0, solid_capstyle="butt", zorder=2, label=None if index else "wall")
    sensed = sensor_reach(log) is not None
    named: set[str] = set()
    for (x, y, radius), first in zip(log.layout.cylinders.tolist(), first_sights(log), strict=True):
        seen = first is not None and first <= tick
        label = ("cylinder seen by then" if seen else "not seen yet") if sensed else "cylinder"
        ax.add_patch(
            Circle(
                (x, y),
                radius,
                zorder=2,
                lw=1.0,
                label=None if label in named else label,
                facecolor=css("fixed") if seen else "none",
                edgecolor=css("fixed") if seen else GREY,
                linestyle="-" if seen else (0, (3, 2)),
            )
        )
        named.add(label)
    for index, (x, y, radius) in enumerate(log.movers[tick].tolist()):
        name = None if index else "moving cylinder, and its way so far"
        ax.plot(*log.movers[: tick + 1, index, :2].T, color=css("moving"), lw=0.9, alpha=0.6, zorder=2)
        ax.add_patch(Circle((x, y), radius, facecolor=css("moving"), edgecolor="none", zorder=2, label=name))


def _landmarks(log: FlightLog, tick: int, ax: Axes) -> None:
    from matplotlib.patches import Ellipse

    row = log.landmarks[tick]
    for index, (mean, covariance) in enumerate(zip(row.means, row.covariances, strict=True)):
        long, short, direction = ellipse_axes(covariance, SIGMAS)
        ax.add_patch(
            Ellipse(
                (float(mean[0]), float(mean[1])),
                2.0 * long,
                2.0 * short,
                angle=math.degrees(direction),
                zorder=6,
                facecolor=(*_rgb("estimate"), 0.45),
                edgecolor=css("estimate"),
                lw=0.8,
                label=None if index else "landmark as believed, 2\u03c3",
            )
        )


def _rgb(name: str) -> tuple[float, float, float]:
    from matplotlib.colors import to_rgb

    return to_rgb(css(name))
