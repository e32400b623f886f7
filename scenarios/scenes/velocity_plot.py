"""A drive as one picture: speed against the profile, what is missed, forces, and the way to convergence."""

from __future__ import annotations

from unifg.plots.descent import draw_errors
from unifg.scenarios.scenes.panels import plot_held
from unifg.scenarios.velocity_tracking import Drive, metrics
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import face, headline, new_figure
from unifg.typing import Figure

__all__ = ["picture"]

_KKT = ("stationarity", "violation", "complementarity")


def picture(drive: Drive) -> Figure:
    """Speed, deviation and force over time, and the numbers of every iterate."""
    d, time = drive, drive.time
    with new_figure((11.0, 9.5)) as figure:
        speed, error, force, convergence = figure.subplots(4, 1, height_ratios=(1.5, 0.7, 1.2, 1.0))
        speed.plot(time, d.profile.speed, color=css("goal"), lw=4.5, label="profile to follow")
        speed.plot(time, d.speed, color=css("robot"), lw=1.6, label="speed of the vehicle")
        speed.set_ylim(min(0.0, 1.05 * float(d.speed.min())), 1.08 * float(max(d.profile.speed.max(), 1.0)))
        error.axhline(0.0, color=GREY, lw=0.8)
        error.plot(time, d.error, color=css("moving"), lw=1.1)
        title, name = "Drive and brake force", "force of the vehicle"
        plot_held(force, time, d.force, d.settings.force_bounds, title, "force [N]", name)
        car = d.settings.vehicle.linearised() if d.settings.linear else d.settings.vehicle
        resistance = car.resistance(d.speed, d.profile.slope)
        force.plot(time, resistance, color=INK, lw=1.0, ls=(0, (4, 2)), label="resistance of air and road")
        force.set_xlabel("time [s]")
        draw_errors(convergence, {name: d.solution.history.column(name) for name in _KKT}, d.settings.tolerance)
        for ax, title, y in ((speed, "Speed", "speed [m/s]"), (error, "Deviation from the profile", "v - v_ref [m/s]")):
            face(ax, title, y)
            ax.set_xlim(0.0, time[-1])
        face(convergence, "What is wrong with each iterate", x="iterate")
        for ax in (speed, force, convergence):
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=4)
        figure.align_ylabels()
        headline(figure, _title(d), 12.0)
    return figure


def _title(drive: Drive) -> str:
    m = metrics(drive)
    ended = "optimum" if m["converged"] else m["status"].replace("_", " ")
    bounds = "" if m["within_bounds"] else ", a force limit BROKEN"
    return (
        f"{m['profile']}, {m['length']} steps of {drive.profile.dt:g} s, {m['drag']} drag\n"
        f"{ended} after {m['iterations']} iterations of {m['solver']}, J = {m['cost']:.6f}{bounds}"
    )
