"""A drive as one picture: where it went on the map, and how well it went over time."""

from __future__ import annotations

import numpy as np

from unifg.plots.shown import every
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.logs.metrics import collision_words, one_graph
from unifg.scenarios.scenes.drive_scene import drive_stage, place_movers
from unifg.scenarios.scenes.panels import over_time, plot_clearance, plot_times, shade_trouble, timed_way
from unifg.style.colours import css
from unifg.style.figures import headline, new_figure
from unifg.typing import Axes, Figure

__all__ = ["overview", "plot_controls", "plot_localisation", "plot_map"]

_DOTS = 200  # along the way of the wheels


def overview(log: EpisodeLog) -> Figure:
    """The map on the left; errors, controls, clearance and times of ticks over time on the right.

    Raises:
        ViewError: the drive has no tick.
    """
    with new_figure((15.0, 9.4), log.ticks) as figure:
        left, right = figure.subfigures(1, 2, width_ratios=(1.75, 1.0), squeeze=False)[0]
        place = plot_map(log, left.subplots())
        left.legend(*place.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        panels = right.subplots(5, 1, sharex=True)
        plot_localisation(log, panels[0])
        plot_controls(log, panels[1], panels[2])
        plot_clearance(log, panels[3])
        plot_times(log, log.tick_ms, {"localise": (log.localise_ms, "estimate")}, panels[4])
        panels[-1].set_xlabel("time [s]")
        right.align_ylabels(panels)
        headline(figure, _title(log))
    return figure


def plot_map(log: EpisodeLog, ax: Axes) -> Axes:
    """The scene of the end of the drive from above, with the ways of the estimate, of the wheels and of what moves."""
    scene = drive_stage(log, log.outcomes)
    thin = 0.3 * (scene.layers["trail"].width or 0.0)
    movers = {f"way {k}": log.obstacles[:, k, :2] for k in np.flatnonzero(log.obstacle_moves)}
    for name, way in movers.items():
        scene.way(name, way, width=thin, colour="moving", legend="")
    scene.way("estimate (lidar)", log.estimate[:, :2], width=thin, colour="estimate")
    dots = log.dead_reckoning[every(log.ticks, _DOTS), :2]  # a line would look like the route
    scene.points("wheel odometry alone", dots, pixels=2.5, colour="odometry")
    if log.emergency.any():
        stored = log.true_pose[log.emergency, :2]
        scene.points("stored", stored, colour="detected", legend="stored plan driven")
    frame = scene.frame()
    frame.place("robot", log.true_pose[-1])
    place_movers(frame, log, log.ticks - 1)
    scene.draw(ax)
    timed_way(ax, log.true_pose[:, :2], log.time, "way driven, at")
    ax.set_title("Where it went")
    return ax


def plot_localisation(log: EpisodeLog, ax: Axes) -> Axes:
    """Distance between estimate and truth over time [cm], with dead reckoning where it fits into the picture."""
    error, odometry = (pose_errors(poses, log.true_pose)[0] for poses in (log.estimate, log.dead_reckoning))
    curves = (
        (100.0 * error, {"color": css("estimate"), "label": "estimate (lidar)"}),
        (100.0 * odometry, {"color": css("odometry"), "ls": ":", "label": "wheel odometry alone"}),
    )
    top = 100.0 * max(1.3 * float(error.max()), 3.0 * float(error.mean()), 0.01)
    title = f"Localisation error, {100.0 * error.mean():.1f} cm on average"
    over_time(log, ax, title, "error [cm]", curves, bounds=(0.0, top))
    if odometry.max() > error.max():
        ax.annotate(
            f"odometry ends {odometry[-1]:.2f} m off",
            xy=(0.995, 0.93), xycoords="axes fraction", ha="right", va="top", fontsize=8, color="#5b6472",
        )  # fmt: skip
    return ax


def plot_controls(log: EpisodeLog, speed: Axes, turning: Axes) -> None:
    """Forward and turning speed, or the steering angle, over time against their limits, in two axes."""
    turn = ("$\\omega$ [rad/s]", "Turning speed and its limits")
    if log.base.startswith("ackermann"):
        turn = ("$\\delta$ [rad]", "Steering angle and its limits")
    names = (("v [m/s]", "Forward speed and its limits"), turn)
    style = {"color": css("robot"), "lw": 1.1, "drawstyle": "steps-post"}
    for ax, column, (label, title) in zip((speed, turning), (0, -1), names, strict=True):
        limit, curves = log.control_limits[column], [(log.control[:, column], {**style, "label": "forward"})]
        if column == 0 and log.control.shape[1] > 2:
            curves.append((log.control[:, 1], {**style, "color": css("estimate"), "label": "sideways"}))
        over_time(log, ax, title, label, curves, levels=(-limit, limit), bounds=(-1.18 * limit, 1.18 * limit))
        if len(curves) > 1:
            ax.legend(loc="upper right", ncols=2, borderpad=0.0)
    shade_trouble(speed, log.dt, log.health, log.cause, "Forward speed")
    if float(log.control[:, :-1].min()) >= 0.0:  # it never reversed: show the half that was used
        speed.set_ylim(bottom=-0.08 * log.control_limits[0])


def _title(log: EpisodeLog) -> str:
    m = episode_metrics(log)
    stopped = ", interrupted" if log.interrupted else ""
    # The same thing may have ended every goal: said once, and by its first words, as a line is only so long.
    missed = dict.fromkeys(words.partition(":")[0] for words in log.outcomes if words != "reached")
    stopped += "".join(f", {words}" for words in missed)
    return (
        f"{log.scenario} on {log.occupancy.name}{one_graph(log.coupling)}: "
        f"{m['goals_reached']} of {m['goals']} goals reached, "
        f"{collision_words(log.collisions)}{stopped}  |  {m['path_length_m']:.1f} m in {m['duration_s']:.1f} s  |  "
        f"solver {log.solver} ({log.coupling}), seed {log.seed}"
    )
