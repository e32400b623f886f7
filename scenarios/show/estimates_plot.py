"""What a flight believed against what was true: parameters and states over time with bands of two standard deviations.

Each function draws into the axes it is given, or into new ones, and returns them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import PARAMETERS, estimated_parameters, has_estimate, state_errors
from unifg.scenarios.show.style import INK, css, finish, heading, new_figure, over_time, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["estimates", "plot_parameter", "plot_state_error", "write_estimates"]

_COLUMNS = 3
_NAMES = ("Mass", "Drag along x", "Drag along y", "Drag along z", "Wind along x", "Wind along y", "Updraft")
_UNITS = ("kg", "kg/s", "kg/s", "kg/s", "m/s\u00b2", "m/s\u00b2", "m/s\u00b2")
_STATES = (
    *(f"Position error, {axis} [cm]" for axis in "xyz"),
    *(f"Attitude error, body {axis} [mrad]" for axis in "xyz"),
    *(f"Velocity error, {axis} [cm/s]" for axis in "xyz"),
)
_SCALES = (100.0, 1000.0, 100.0)
_SHOWN = (0, 1, 2, 6, 7, 8, 3, 4, 5)  # position, velocity, attitude


def write_estimates(path: str | Path, log: FlightLog, *, dpi: int = 120) -> Path:
    """Write the estimates of a flight as a PNG.

    Args:
        path: file to write; an existing one is replaced.
        log: a flight with an estimate.
        dpi: dots per inch of a figure 15 inches wide.

    Returns:
        The path written.

    Raises:
        ScenarioError: the flight has no tick or no estimate.
    """
    return write_figure(path, estimates(log), dpi)


def estimates(log: FlightLog) -> Figure:
    """Every parameter that is estimated, then the errors of position, velocity and attitude.

    Args:
        log: a flight with an estimate.

    Raises:
        ScenarioError: the flight has no tick or no estimate.
    """
    if log.ticks and not has_estimate(log):
        raise ScenarioError("nobody estimated in this flight: it has neither sigmas nor windows")
    parameters = np.flatnonzero(estimated_parameters(log)).tolist()
    rows = math.ceil(len(parameters) / _COLUMNS) + len(_STATES) // _COLUMNS
    with new_figure(log, (15.0, 2.05 * rows + 0.9)) as figure:
        panels = list(figure.subplots(rows, _COLUMNS, sharex=True, squeeze=False).flat)
        for ax, index in zip(panels, parameters, strict=False):
            plot_parameter(log, PARAMETERS[index], ax=ax)
        begin = len(panels) - len(_STATES)
        for ax in panels[len(parameters) : begin]:
            ax.set_axis_off()
        for ax, component in zip(panels[begin:], _SHOWN, strict=True):
            plot_state_error(log, component, ax=ax)
        for ax in panels[-_COLUMNS:]:
            ax.set_xlabel("time [s]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        heading(log, figure, "What it believed")
    return figure


def plot_parameter(log: FlightLog, name: str, ax: Axes | None = None) -> Axes:
    """One parameter over time, its band of two standard deviations, and the truth.

    Args:
        log: the flight.
        name: one of `unifg.scenarios.log.flight_metrics.PARAMETERS`.
        ax: axes to draw into; None for new ones.
    """
    ax, index = over_time(ax), PARAMETERS.index(name)
    values, sigmas = log.parameters[:, index], log.parameters_sigma[:, index]
    true = float(log.parameters_true[index])
    ax.fill_between(
        log.time, values - 2.0 * sigmas, values + 2.0 * sigmas, color=css("estimate"), alpha=0.18, lw=0,
        label="\u00b1 2\u03c3",
    )  # fmt: skip
    ax.plot(log.time, values, color=css("estimate"), lw=1.5, label="estimate")
    ax.axhline(true, color=INK, lw=1.1, ls="--", label="truth (errors: zero)")
    inside = float(np.mean(np.abs(values - true) <= 2.0 * sigmas))
    ends = f"ends {100.0 * (values[-1] / true - 1.0):+.1f} %" if index == 0 else f"ends {values[-1] - true:+.3f}"
    ax.set_title(f"{_NAMES[index]}, {ends}; {100.0 * inside:.0f} % within 2\u03c3")
    ax.set_ylabel(f"[{_UNITS[index]}]")
    # A first guess that knows nothing would flatten the rest.
    settled = slice(min(10, log.ticks - 1), None)
    low = min(true, float((values - 2.5 * sigmas)[settled].min()), float(values.min()))
    high = max(true, float((values + 2.5 * sigmas)[settled].max()), float(values.max()))
    margin = 0.08 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)
    return finish(log, ax)


def plot_state_error(log: FlightLog, component: int, ax: Axes | None = None) -> Axes:
    """One component of the right perturbation from belief to truth, in a band of two standard deviations around zero.

    Args:
        log: the flight.
        component: 0-2 position, 3-5 attitude, 6-8 velocity.
        ax: axes to draw into; None for new ones.
    """
    ax, scale = over_time(ax), _SCALES[component // 3]
    error = scale * state_errors(log)[:, component]
    sigma = scale * log.believed_sigma[:, component]
    ax.fill_between(log.time, -2.0 * sigma, 2.0 * sigma, color=css("robot"), alpha=0.15, lw=0, label="\u00b1 2\u03c3")
    ax.plot(log.time, error, color=css("robot"), lw=1.2, label="error")
    ax.axhline(0.0, color=INK, lw=0.9, ls="--")
    inside = float(np.mean(np.abs(error) <= 2.0 * sigma))
    name, unit = _STATES[component].split(" [")
    rms = math.sqrt(float(np.mean(error**2)))
    ax.set_title(f"{name}, {rms:.1f} {unit[:-1]} rms; {100.0 * inside:.0f} % within 2\u03c3")
    ax.set_ylabel(f"[{unit}")
    return finish(log, ax)
