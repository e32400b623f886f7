"""A drive as one picture: speed against the profile, what is missed, forces, and the way to convergence."""

from __future__ import annotations

from unifg.plots.descent import draw_errors
from unifg.scenarios.scenes.panels import plot_held
from unifg.scenarios.velocity_tracking import Drive, metrics
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import face, headline, new_figure
from unifg.typing import Axes, Figure

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
    title, name = "Drive and brake force", "force of the vehicle"
    plot_held(ax, drive.time, drive.force, drive.settings.force_bounds, title, "force [N]", name)
    car = drive.settings.vehicle.linearised() if drive.settings.linear else drive.settings.vehicle
    resistance = car.resistance(drive.speed, drive.profile.slope)
    ax.plot(drive.time, resistance, color=INK, lw=1.0, ls=(0, (4, 2)), label="resistance of air and road")
    _key(ax)
    return ax


def plot_numbers(drive: Drive, ax: Axes) -> Axes:
    """The KKT numbers of every iterate; those that are zero throughout are left out."""
    history, kkt = drive.solution.history, ("stationarity", "violation", "complementarity")
    draw_errors(ax, {name: history.column(name) for name in kkt}, drive.settings.tolerance)
    _key(ax)
    return face(ax, "What is wrong with each iterate", x="iterate")


def _key(ax: Axes) -> None:
    """The legend beside the title, where it hides nothing."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=4)


def _title(drive: Drive) -> str:
    m = metrics(drive)
    ended = "optimum" if m["converged"] else m["status"].replace("_", " ")
    bounds = "" if m["within_bounds"] else ", a force limit BROKEN"
    return (
        f"{m['profile']}, {m['length']} steps of {drive.profile.dt:g} s, {m['drag']} drag\n"
        f"{ended} after {m['iterations']} iterations of {m['solver']}, J = {m['cost']:.6f}{bounds}"
    )
