"""A drive as one picture: where it went on the map, and how well it went over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.logs.metrics import collision_words
from unifg.scenarios.scenes.panels import over_time, plot_clearance, plot_times, shade_trouble
from unifg.style.colours import INK, css
from unifg.style.figures import discs, ground, headline, new_axes, new_figure, word
from unifg.typing import Array
from unifg.view.shapes import known_corners

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["overview", "plot_controls", "plot_localisation", "plot_map"]


def overview(log: EpisodeLog) -> Figure:
    """The map on the left; errors, controls, clearance and solve times over time on the right.

    Raises:
        ViewError: the drive has no tick.
    """
    with new_figure((15.0, 9.4), log.ticks) as figure:
        left, right = figure.subfigures(1, 2, width_ratios=(1.75, 1.0), squeeze=False)[0]
        place = plot_map(log, ax=left.subplots(), legend=False)
        left.legend(*place.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        panels = right.subplots(5, 1, sharex=True)
        plot_localisation(log, ax=panels[0])
        plot_controls(log, ax=(panels[1], panels[2]))
        plot_clearance(log, ax=panels[3])
        plot_times(log, log.solve_ms, {"localise": (log.localise_ms, "estimate")}, ax=panels[4])
        panels[-1].set_xlabel("time [s]")
        right.align_ylabels(panels)
        headline(figure, _title(log))
    return figure


def plot_map(log: EpisodeLog, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """The map seen from above with all paths, obstacles, start and goals.

    Args:
        log: the drive.
        ax: axes to draw into; None for new ones.
        legend: False leaves out the legend below the axes.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.transforms import Affine2D

    ax = new_axes(ax)
    occupancy = log.occupancy
    classes = np.where(occupancy.occupied, 2, np.where(occupancy.free, 1, 0))
    height, width = occupancy.shape
    image = ax.imshow(
        classes,
        cmap=ListedColormap(["#e4e7eb", "#ffffff", "#8e97a3"]),
        vmin=0,
        vmax=2,
        origin="lower",
        extent=(0.0, width * occupancy.resolution, 0.0, height * occupancy.resolution),
        interpolation="nearest",
        zorder=0,
    )
    image.set_transform(Affine2D().rotate(occupancy.origin[2]).translate(*occupancy.origin[:2]) + ax.transData)

    _obstacles(log, ax)
    ax.plot(*log.path[:, :2].T, color=css("plan"), lw=1.2, ls=(0, (4, 2)), label="planned path", zorder=3)
    dead_reckoning = log.dead_reckoning[:, :2].T
    ax.plot(*dead_reckoning, color=css("odometry"), lw=1.4, ls=":", label="wheel odometry alone", zorder=4)
    ax.plot(*log.true_pose[:, :2].T, color=css("trail"), lw=3.6, label="true path", zorder=5)
    ax.plot(*log.estimate[:, :2].T, color=css("estimate"), lw=1.1, label="estimate (lidar)", zorder=6)
    stored = log.true_pose[log.emergency]
    if len(stored):
        ax.plot(*stored[:, :2].T, "x", color="#000000", ms=5, mew=1.2, label="stored plan driven", zorder=7)
    _poses(log, ax)

    everything = np.concatenate([known_corners(occupancy), log.true_pose[:, :2], log.goals[:, :2]])
    margin = 0.02 * float(np.ptp(everything, axis=0).max())
    ground(ax, everything.min(axis=0) - margin, everything.max(axis=0) + margin)
    ax.set_title("Where it went")
    if legend:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=4)
    return ax


def plot_localisation(log: EpisodeLog, ax: Axes | None = None) -> Axes:
    """Distance between estimate and truth over time [cm], with dead reckoning where it fits into the picture."""
    error, odometry = (pose_errors(poses, log.true_pose)[0] for poses in (log.estimate, log.dead_reckoning))
    curves = (
        (100.0 * error, {"color": css("estimate"), "label": "estimate (lidar)"}),
        (100.0 * odometry, {"color": css("odometry"), "ls": ":", "label": "wheel odometry alone"}),
    )
    top = 100.0 * max(1.3 * float(error.max()), 3.0 * float(error.mean()), 0.01)
    title = f"Localisation error, {100.0 * error.mean():.1f} cm on average"
    ax = over_time(log, ax, title, "error [cm]", curves, bounds=(0.0, top))
    if odometry.max() > error.max():
        ax.annotate(
            f"odometry ends {odometry[-1]:.2f} m off",
            xy=(0.995, 0.93), xycoords="axes fraction", ha="right", va="top", fontsize=8, color="#5b6472",
        )  # fmt: skip
    return ax


def plot_controls(log: EpisodeLog, ax: tuple[Axes, Axes] | None = None) -> tuple[Axes, Axes]:
    """Forward and turning speed over time against their limits, in two axes."""
    both = (new_axes(None), new_axes(None)) if ax is None else ax
    names = (("v [m/s]", "Forward speed and its limits"), ("$\\omega$ [rad/s]", "Turning speed and its limits"))
    style = {"color": css("robot"), "lw": 1.1, "drawstyle": "steps-post"}
    for axes, values, limit, (label, title) in zip(both, log.control.T, log.control_limits, names, strict=True):
        bounds, curve = (-1.18 * limit, 1.18 * limit), (values, style)
        over_time(log, axes, title, label, [curve], levels=(-limit, limit), bounds=bounds)
    shade_trouble(both[0], log.dt, log.health, log.cause, "Forward speed")
    if float(log.control[:, 0].min()) >= 0.0:  # it never reversed: show the half that was used
        both[0].set_ylim(-0.08 * log.control_limits[0], 1.18 * log.control_limits[0])
    return both


def _obstacles(log: EpisodeLog, ax: Axes) -> None:
    """Discs at their last place; discs that move also at places passed, fading into the past."""
    moving = log.obstacle_moves
    style: dict[str, Any] = {"edgecolor": "none", "zorder": 2}
    if len(log.obstacles[-1, ~moving]):
        discs(ax, log.obstacles[-1, ~moving], "unforeseen obstacle", fc=css("fixed"), alpha=0.95, **style)
    for places in log.obstacles[:, moving].transpose(1, 0, 2):
        ax.plot(*places[:, :2].T, color=css("moving"), lw=0.8, zorder=2)
        shown = _apart(places)
        for rank, place in enumerate(shown[:-1], start=1):
            discs(ax, place, fc=css("moving"), alpha=0.1 + 0.3 * rank / len(shown), **style)
    name = "moving obstacle (fading into the past)"
    discs(ax, log.obstacles[-1, moving], name, fc=css("moving"), alpha=0.95, **style)


def _apart(places: Array) -> Array:
    """The last place and earlier ones at least 1.5 radii from all later ones kept, oldest first."""
    kept = [places[-1]]
    for place in places[-2::-1]:
        if np.linalg.norm(np.array(kept)[:, :2] - place[:2], axis=1).min() >= 1.5 * place[2]:
            kept.append(place)
    return np.array(kept[::-1])


def _poses(log: EpisodeLog, ax: Axes) -> None:
    """Start, goals and the robot where the drive ended, with short strokes for their headings."""
    stroke = 0.03 * float(np.ptp(known_corners(log.occupancy), axis=0).max())
    named = [("start", log.start, "o", css("start"))]
    for index, goal in enumerate(log.goals):
        name = "goal" if len(log.goals) == 1 else f"goal {index + 1}"
        named.append((name + ("" if log.reached[index] else " (missed)"), goal, "*", css("goal")))
    for name, pose, marker, colour in named:
        x, y, heading = pose.tolist()
        ends = [x, x + stroke * np.cos(heading)], [y, y + stroke * np.sin(heading)]
        ax.plot(*ends, color=INK, lw=1.4, zorder=8)
        ax.plot(x, y, marker, color=colour, ms=15 if marker == "*" else 8, mec=INK, mew=0.8, zorder=9)
        word(ax, pose, name, (0, -9), va="top", zorder=10)
    robot = [*log.true_pose[-1, :2], log.robot_radius]
    discs(ax, robot, facecolor=css("robot"), edgecolor="white", lw=0.5, zorder=7)


def _title(log: EpisodeLog) -> str:
    m = episode_metrics(log)
    stopped = ", interrupted" if log.interrupted else ""
    # The same thing may have ended every goal: said once, and by its first words, as a line is only so long.
    missed = dict.fromkeys(words.partition(":")[0] for words in log.outcomes if words != "reached")
    stopped += "".join(f", {words}" for words in missed)
    return (
        f"{log.scenario} on {log.occupancy.name}: {m['goals_reached']} of {m['goals']} goals reached, "
        f"{collision_words(log.collisions)}{stopped}  |  {m['path_length_m']:.1f} m in {m['duration_s']:.1f} s  |  "
        f"solver {log.solver} ({log.coupling}), seed {log.seed}"
    )
