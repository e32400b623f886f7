"""Flights that must keep their distance, side by side: ways from above, speeds, distances, time to decide.

After FactorMPC, Fig. 4 to 7 and 10: the speed of the path is the dashed curve, distances are those beyond the margin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unifg.scenarios.logs.safe_log import SafeLog
from unifg.scenarios.scenes.safe_scene import place_bodies, resting, safe_stage
from unifg.style.colours import GREY, css
from unifg.style.figures import face, ground, headline, new_figure
from unifg.typing import Array, Axes, Figure

__all__ = ["picture", "plot_above"]

_LINES = ("robot", "estimate", "horizon", "scan", "trail", "moving", "fixed", "start")
_STAMPS = 6  # places drawn of a body that moves
_BESIDE = 0.6  # around everything [m]
_TITLES = {
    "static": "A quadrotor is to follow a line through a cylinder",
    "ellipse": "A quadrotor is to follow a line that a sphere keeps crossing on an ellipse",
    "cluttered": "A quadrotor is to follow a line through things at rest and things that move",
    "figure8": "A quadrotor whose mass and drag are not in the books follows a figure eight",
    "ball": "A ball is thrown at a quadrotor that hovers",
}


def picture(logs: Sequence[SafeLog]) -> Figure:
    """Ways from above, speeds, distances and times to decide of one or more flights of the same case."""
    guarded = bool(logs) and len(logs[0].radii) > 0
    with new_figure((11.0, 8.0), min((log.ticks for log in logs), default=0)) as figure:
        (above, speed), (near, clock) = figure.subplots(2, 2, width_ratios=(1.15, 1.0))
        plot_above(logs, above)
        paths = [np.linalg.norm(log.wanted[:, 3:], axis=1) for log in logs]
        for k, (log, path) in enumerate(zip(logs, paths, strict=True)):
            if not any(len(path) == len(other) and np.allclose(path, other) for other in paths[:k]):
                speed.plot(log.time, path, color=GREY, lw=1.2, ls="--")
        for log, colour in zip(logs, map(css, _LINES * len(logs)), strict=False):
            gaps = log.boundary if guarded else 1e3 * np.linalg.norm(log.error, axis=1)
            speed.plot(log.time, np.linalg.norm(log.states[:, 7:], axis=1), color=colour, lw=1.4)
            near.plot(log.time, gaps, color=colour, lw=1.4)
            clock.plot(np.sort(log.decide_ms), 100.0 * np.arange(1, log.ticks + 1) / log.ticks, color=colour, lw=1.4)
            if guarded:
                near.plot(log.time[np.argmin(gaps)], gaps.min(), "o", color=colour, ms=4)
        face(speed, "Speed; dashed: of the path", "[m/s]", "time [s]")
        face(near, "Distance from the path", "[mm]", "time [s]")
        if guarded:
            near.axhline(0.0, color=css("moving"), lw=1.0)
            near.set_ylim(top=min(near.get_ylim()[1], 4.0))
            face(near, "Boundary distance: beyond the margin, along the whole way", "[m]", "time [s]")
        clock.set_ylim(0.0, 102.0)
        clock.set_xlim(left=0.0)
        face(clock, "Ticks decided within a processor time", "[%]", "[ms]")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        headline(figure, _TITLES[str(logs[0].settings["case"])])
    return figure


def plot_above(logs: Sequence[SafeLog], ax: Axes) -> Axes:
    """Ways from above; what moves is drawn at a few times, the later the darker."""
    first = logs[0]
    scene = safe_stage(first, resting(first))
    scene.way("path", first.wanted[:, :3])
    for index, rests in enumerate(resting(first)):
        places, radius = first.bodies[:, index, :2], first.radii[index]
        if rests:
            continue
        scene.way(f"way {index}", places, width=0.03, colour="moving", legend="")
        for k, tick in enumerate(np.linspace(0, first.ticks - 1, _STAMPS).round().astype(int).tolist()):
            opacity = 0.15 + 0.5 * k / _STAMPS
            row = [[*places[tick], radius]]
            scene.discs(f"body {index}, {k}", row, opacity=opacity, colour="moving", legend="")
    for log, colour in zip(logs, _LINES * len(logs), strict=False):
        scene.way(log.label, log.states[:, :3], width=0.06, colour=colour)
    place_bodies(scene.frame(), first, first.ticks - 1)
    ax = scene.draw(ax)
    ground(ax, *_extent(logs))
    ax.set_title("From above; rings: nearer than this the margin is not kept" if len(first.radii) else "From above")
    return ax


def _extent(logs: Sequence[SafeLog]) -> tuple[Array, Array]:
    """Corners (2,) of the ground that is shown [m]: ways and path, and bodies that are not far away."""
    first = logs[0]
    ends = np.concatenate([log.states[:, :2] for log in logs] + [first.wanted[:, :2]])
    if len(first.radii):
        near = first.bodies[0][:, :2]
        inside = np.abs(near).max(axis=1) < 50.0
        reach = first.radii[inside, None]
        ends = np.concatenate([ends, near[inside] - reach, near[inside] + reach])
    return ends.min(axis=0) - _BESIDE, ends.max(axis=0) + _BESIDE
