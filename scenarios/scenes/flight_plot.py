"""A flight as pictures: from above at several moments, what it believed against the truth, and how it was flown.

The view from above is as in Fig. 5 of Ta, Kobilarov and Dellaert (ICUAS 2014), a frame of the scene: the estimated past
is blue, the predicted future green, the reach of the sensor magenta; cylinders not seen by then are faint.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unifg.plots.shown import every
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import estimated_parameters, has_estimate, state_errors
from unifg.scenarios.logs.metrics import collision_words
from unifg.scenarios.scenes.flight_scene import flight_frame, flight_stage, senses
from unifg.scenarios.scenes.panels import over_time, padded, plot_clearance, plot_times, shade_trouble
from unifg.style.colours import INK, css
from unifg.style.figures import ground, headline, key_of, new_figure
from unifg.typing import Array, Axes, Figure

__all__ = ["control", "estimates", "overview", "plot_moment", "plot_parameter", "plot_state_error"]

_MOMENTS = 6  # evenly spread from the first tick to the last
_MARGIN = 0.6  # around the layout [m]
_WIDE = 2.0  # layouts at least this many times as long as wide are drawn in two columns, others in three
_COLUMNS = 3  # of panels with estimates
_NAMES = ("Mass", "Drag along x", "Drag along y", "Drag along z", "Wind along x", "Wind along y", "Updraft")
_UNITS = ("kg", "kg/s", "kg/s", "kg/s", "m/s\u00b2", "m/s\u00b2", "m/s\u00b2")
_STATES = (
    *(f"Position error, {axis} [cm]" for axis in "xyz"),
    *(f"Attitude error, body {axis} [mrad]" for axis in "xyz"),
    *(f"Velocity error, {axis} [cm/s]" for axis in "xyz"),
)
_SCALES = (100.0, 1000.0, 100.0)
_SHOWN = (0, 1, 2, 6, 7, 8, 3, 4, 5)  # position, velocity, attitude
_CONTROLS = {"Roll rate": "[rad/s]", "Pitch rate": "[rad/s]", "Yaw rate": "[rad/s]", "Thrust": "[N]"}


def overview(log: FlightLog) -> Figure:
    """Six moments from above, evenly spread from the first tick to the last.

    Raises:
        ViewError: the flight has no tick.
    """
    width, height = np.ptp(log.layout.size, axis=0) + 2.0 * _MARGIN
    columns = 2 if width >= _WIDE * height else 3
    shown = every(log.ticks, _MOMENTS)
    rows = math.ceil(len(shown) / columns)
    panel = 14.4 / columns
    with new_figure((15.0, rows * (panel * height / width + 0.42) + 1.1), log.ticks) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for ax in grid.flat[len(shown) :]:
            ax.set_axis_off()
        for ax, tick in zip(grid.flat, shown.tolist(), strict=False):
            plot_moment(log, tick, ax).label_outer()
        figure.legend(*key_of(grid.flat), loc="outside lower center", ncols=4)
        reached = "target reached" if log.reached else "target not reached"
        how = "" if log.outcome in ("", "reached", "interrupted") else f", {log.outcome}"
        headline(figure, _title(log, f"{reached}, {collision_words(log.collisions)}{how}"))
    return figure


def estimates(log: FlightLog) -> Figure:
    """Every parameter that is estimated, then the errors of position, velocity and attitude.

    Raises:
        ViewError: the flight has no tick.
    """
    parameters = np.flatnonzero(estimated_parameters(log)).tolist()
    rows = math.ceil(len(parameters) / _COLUMNS) + len(_STATES) // _COLUMNS
    with new_figure((15.0, 2.05 * rows + 0.9), log.ticks) as figure:
        panels = list(figure.subplots(rows, _COLUMNS, sharex=True, squeeze=False).flat)
        for ax, index in zip(panels, parameters, strict=False):
            plot_parameter(log, index, ax)
        begin = len(panels) - len(_STATES)
        for ax in panels[len(parameters) : begin]:
            ax.set_axis_off()
        for ax, component in zip(panels[begin:], _SHOWN, strict=True):
            plot_state_error(log, component, ax)
        for ax in panels[-_COLUMNS:]:
            ax.set_xlabel("time [s]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        headline(figure, _title(log, "What it believed"))
    return figure


def control(log: FlightLog) -> Figure:
    """Body rates and thrust with their limits on the left; speed and height, clearance and timing on the right.

    Raises:
        ViewError: the flight has no tick.
    """
    s, thick = log.settings["controller"], {"color": css("robot"), "lw": 1.4}
    limits = [*((-rate, rate) for rate in s["rate_limits"]), s["thrust_limits"]]
    with new_figure((15.0, 9.2), log.ticks) as figure:
        left, right = figure.subfigures(1, 2, squeeze=False)[0]
        panels, others = left.subplots(4, 1, sharex=True), right.subplots(4, 1, sharex=True)
        for ax, values, ends, (name, unit) in zip(panels, log.controls.T, limits, _CONTROLS.items(), strict=True):
            curve = values, {"color": css("robot"), "drawstyle": "steps-post"}
            bounds = padded(values, ends, least=0.1)
            over_time(log, ax, f"{name} and its limits", unit, [curve], levels=ends, bounds=bounds)
        speed, height = np.linalg.norm(log.truth[:, 7:], axis=1), log.truth[:, 2]
        title = f"Speed, at most {speed.max():.2f} m/s"
        over_time(log, others[0], title, "[m/s]", [(speed, thick)], bounds=(0.0, 1.12 * max(float(speed.max()), 0.1)))
        shade_trouble(others[0], log.dt, log.health, log.causes, title)
        target = np.full(log.ticks, log.layout.target[2])
        curves = (height, thick), (target, {"color": css("goal"), "lw": 1.4, "ls": "--"})
        top = 1.15 * max(float(height.max()), float(target[0]), 0.1)
        over_time(log, others[1], "Height, and that of the target", "[m]", curves, bounds=(0.0, top))
        plot_clearance(log, ax=others[2])
        parts = {"plan": (log.plan_ms, "horizon"), "estimate": (log.estimate_ms, "estimate")}
        ax = plot_times(log, log.estimate_ms + log.plan_ms, parts, ax=others[3])
        ax.axhline(1e3 * log.dt, color=css("moving"), lw=1.1, label="control period")
        ax.legend(loc="upper right", ncols=4, markerscale=3, borderpad=0.0)
        for part, axes in ((left, panels), (right, others)):
            axes[-1].set_xlabel("time [s]")
            part.align_ylabels(axes)
        stored = int(log.emergency.sum())
        what = "How it was flown" + (f" (grey: {stored} ticks of a stored plan)" if stored else "")
        headline(figure, _title(log, what))
    return figure


def plot_moment(log: FlightLog, tick: int, ax: Axes) -> Axes:
    """Obstacles, belief and plan at one tick, from above."""
    scene = flight_stage(log, sensed=senses(log), estimated=has_estimate(log))
    past, before = slice(tick + 1), max(1, tick + 2 - len(log.pasts[tick]))
    scene.way("trail", log.believed[:before, :3])
    scene.way("truth", log.truth[past, :3] if has_estimate(log) else log.truth[:0, :3])
    flight_frame(scene, scene.frame(), log, tick)
    for index in range(log.movers.shape[1]):
        scene.way(f"way of mover {index}", log.movers[past, index, :2], width=0.05, colour="moving", legend="")
    scene.draw(ax)
    ground(ax, log.layout.size[0] - _MARGIN, log.layout.size[1] + _MARGIN)
    speed = float(np.linalg.norm(log.truth[tick, 7:]))
    stored = ", stored plan flown" if log.emergency[tick] else ""
    said = f"{log.time[tick]:.1f} s, {speed:.1f} m/s, height {log.truth[tick, 2]:.1f} m{stored}"
    ax.set_title(said + (f"\n{log.health[tick]}: {log.causes[tick]}" if log.causes[tick] else ""))
    return ax


def plot_parameter(log: FlightLog, index: int, ax: Axes) -> Axes:
    """One parameter over time, its band of two standard deviations, and the truth.

    Args:
        log: the flight.
        index: of the parameter.
        ax: axes to draw into.
    """
    values, sigmas = log.parameters[:, index], log.parameters_sigma[:, index]
    true = log.parameters_true[:, index]
    ends = f"ends {100.0 * (values / true - 1.0)[-1]:+.1f} %" if index == 0 else f"ends {(values - true)[-1]:+.3f}"
    # A first guess that knows nothing would flatten the rest.
    settled = slice(min(10, log.ticks - 1), None)
    bounds = padded(true, values, (values - 2.5 * sigmas)[settled], (values + 2.5 * sigmas)[settled])
    return _band(log, ax, f"{_NAMES[index]}, {ends}", f"[{_UNITS[index]}]", values, sigmas, true, bounds)


def plot_state_error(log: FlightLog, component: int, ax: Axes) -> Axes:
    """One component of the right perturbation from belief to truth, and two standard deviations around it.

    Args:
        log: the flight.
        component: 0-2 position, 3-5 attitude, 6-8 velocity.
        ax: axes to draw into.
    """
    scale = _SCALES[component // 3]
    error = scale * state_errors(log)[:, component]
    name, unit = _STATES[component].split(" [")
    title = f"{name}, {math.sqrt(float(np.mean(error**2))):.1f} {unit[:-1]} rms"
    return _band(log, ax, title, f"[{unit}", error, scale * log.believed_sigma[:, component])


def _band(
    log: FlightLog,
    ax: Axes,
    title: str,
    unit: str,
    values: Array,
    sigmas: Array,
    true: Array | None = None,
    bounds: tuple[float, float] | None = None,
) -> Axes:
    """Values, the truth, and a band of two sigmas around the values, or around zero for errors, which have no truth."""
    zero = np.zeros_like(values)
    middle, truth, name, colour = zero, zero, "error", "robot"
    if true is not None:
        middle, truth, name, colour = values, true, "estimate", "estimate"
    band: dict[str, Any] = {"color": css(colour), "alpha": 0.17, "lw": 0, "label": "\u00b1 2\u03c3"}
    ax.fill_between(log.time, middle - 2.0 * sigmas, middle + 2.0 * sigmas, **band)
    curves = (
        (values, {"color": css(colour), "lw": 1.4, "label": name}),
        (truth, {"color": INK, "lw": 1.0, "ls": "--", "label": "truth (errors: zero)"}),
    )
    inside = 100.0 * float(np.mean(np.abs(values - truth) <= 2.0 * sigmas))
    return over_time(log, ax, f"{title}; {inside:.0f} % within 2\u03c3", unit, curves, bounds=bounds)


def _title(log: FlightLog, what: str) -> str:
    """Title of a figure: its content and the flight."""
    s = log.settings
    said = f"solver {s['solver']} ({s['coupling']})  |  seed {s['seed']}"
    return f"{what}  |  {s['scenario']}, {log.layout.name}  |  {said}"
