"""A drive as one picture: speed against the profile, what is missed, forces, and the way to convergence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from unifg.scenarios.scenes.panels import forbid, padded, plot_convergence
from unifg.scenarios.velocity_tracking import Drive, metrics
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import face, headline, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["picture", "plot_error", "plot_force", "plot_numbers", "plot_speed"]

_WANTED, _DRIVEN, _MISSED = css("goal"), css("robot"), css("moving")


def picture(drive: Drive) -> Figure:
    """Speed, error and force over time, one above the other; convergence below."""
    with new_figure((11.0, 9.5)) as figure:
        speed, error, force, convergence = figure.subplots(4, 1, height_ratios=(1.5, 0.7, 1.2, 1.0))
        plot_speed(drive, speed)
        plot_error(drive, error)
        plot_force(drive, force)
        for ax in (speed, error, force):
            ax.set_xlim(0.0, drive.time[-1])
        force.set_xlabel("time [s]")
        plot_numbers(drive, convergence)
        figure.align_ylabels()
        headline(figure, _title(drive), 12.0)
    return figure


def plot_speed(drive: Drive, ax: Axes) -> Axes:
    """Speed of the vehicle and the profile."""
    ax.plot(drive.time, drive.profile.speed, color=_WANTED, lw=4.5, label="profile to follow")
    ax.plot(drive.time, drive.speed, color=_DRIVEN, lw=1.6, label="speed of the vehicle")
    face(ax, "Speed", "speed [m/s]")
    ax.set_ylim(bottom=min(0.0, 1.05 * float(drive.speed.min())), top=1.08 * float(max(drive.profile.speed.max(), 1.0)))
    _key(ax)
    return ax


def plot_error(drive: Drive, ax: Axes) -> Axes:
    """Deviation of the speed from the profile."""
    ax.axhline(0.0, color=GREY, lw=0.8)
    ax.plot(drive.time, drive.error, color=_MISSED, lw=1.1)
    return face(ax, "Deviation from the profile", "v - v_ref [m/s]")


def plot_force(drive: Drive, ax: Axes) -> Axes:
    """Force over time, its bounds, and what the road and the air take."""
    bounds, force = drive.settings.force_bounds, drive.force
    low, high = float(min(force.min(), 0.0)), float(max(force.max(), 0.0))
    ax.axhline(0.0, color=GREY, lw=0.8)
    low, high = padded(low, high, bounds or (), share=0.14)
    if bounds is not None:
        forbid(ax, bounds, (low, high), drive.time[-1])
    ax.step(drive.time, np.append(force, force[-1]), where="post", color=_DRIVEN, lw=1.3, label="force of the vehicle")
    car = drive.settings.vehicle.linearised() if drive.settings.linear else drive.settings.vehicle
    resistance = car.resistance(drive.speed, drive.profile.slope)
    ax.plot(drive.time, resistance, color=INK, lw=1.0, ls=(0, (4, 2)), label="resistance of air and road")
    ax.set_ylim(low, high)
    face(ax, "Drive and brake force", "force [N]")
    _key(ax)
    return ax


def plot_numbers(drive: Drive, ax: Axes) -> Axes:
    """The KKT numbers of every iterate."""
    from matplotlib.ticker import MaxNLocator

    history = drive.solution.history
    shown = {"stationarity": (_DRIVEN, "o", "-"), "violation": (INK, "s", "--")}
    if drive.settings.force_bounds is not None:
        shown["complementarity"] = (_MISSED, "^", ":")
    styles = {name: {"color": c, "marker": mark, "ms": 4, "ls": line} for name, (c, mark, line) in shown.items()}

    def values(name: str) -> list[float]:
        """Values of a row; exact zeros, which have no place on a logarithmic axis, are NaN."""
        return [value if (value := getattr(row, name)) > 0.0 else np.nan for row in history]

    plot_convergence(ax, history, styles, drive.settings.tolerance, values)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    _key(ax)
    return ax


def _key(ax: Axes) -> None:
    """The legend beside the title, where it hides nothing."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=3)


def _title(drive: Drive) -> str:
    m = metrics(drive)
    ended = "optimum" if m["converged"] else m["status"].replace("_", " ")
    bounds = "" if m["within_bounds"] else ", a force limit BROKEN"
    return (
        f"{m['profile']}, {m['length']} steps of {drive.profile.dt:g} s, {m['drag']} drag\n"
        f"{ended} after {m['iterations']} iterations of {m['solver']}, J = {m['cost']:.6f}{bounds}"
    )
