"""An episode as one picture: where it went on the map, and how well it went over time.

Each function draws into the axes it is given, or into new ones, and returns them. Figures are made without
matplotlib's global state (no ``pyplot``), so drawing works in threads and on machines without a screen.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.log.drive_metrics import episode_metrics, pose_errors
from unifg.scenarios.show.shapes import known_corners
from unifg.scenarios.show.style import css
from unifg.typing import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "overview",
    "plot_clearance",
    "plot_controls",
    "plot_localisation",
    "plot_map",
    "plot_solve_times",
    "write_overview",
]

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # ships with matplotlib: the same picture everywhere
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a919c",
    "axes.labelcolor": "#1d2430",
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "grid.color": "#e3e6ea",
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "path.simplify": True,
}
_LIMIT = "#6b7280"
_STORED = "stored plan driven"


def write_overview(path: str | Path, log: EpisodeLog, *, dpi: int = 130) -> Path:
    """Write the overview of an episode as a PNG.

    Args:
        path: file to write; an existing one is replaced.
        log: an episode of at least one tick.
        dpi: dots per inch of a figure of 15 x 9.4 inches.

    Returns:
        The path written.

    Raises:
        ScenarioError: the episode has no tick.
    """
    path = Path(path)
    # No software version and no date in the file: the same log gives the same picture.
    overview(log).savefig(path, dpi=dpi, format="png", metadata={"Software": None})
    return path


def overview(log: EpisodeLog) -> Figure:
    """The map on the left; errors, controls, clearance and solve times over time on the right.

    Args:
        log: an episode of at least one tick.

    Raises:
        ScenarioError: the episode has no tick.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if log.ticks == 0:
        raise ScenarioError("the episode has no tick: there is nothing to draw")
    metrics = episode_metrics(log)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(15.0, 9.4), layout="constrained")
        FigureCanvasAgg(figure)
        left, right = figure.subfigures(1, 2, width_ratios=(1.75, 1.0), squeeze=False)[0]
        place = plot_map(log, ax=left.subplots(), legend=False)
        left.legend(*place.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        panels = right.subplots(5, 1, sharex=True)
        plot_localisation(log, ax=panels[0])
        plot_controls(log, ax=(panels[1], panels[2]))
        plot_clearance(log, ax=panels[3])
        plot_solve_times(log, ax=panels[4])
        panels[-1].set_xlabel("time [s]")
        right.align_ylabels(panels)
        figure.suptitle(_title(log, metrics), x=0.01, ha="left", fontsize=12.5, fontweight="bold")
    return figure


def plot_map(log: EpisodeLog, ax: Axes | None = None, *, legend: bool = True) -> Axes:
    """The map seen from above with all paths, obstacles, start and goals.

    Args:
        log: the episode.
        ax: axes to draw into; None for new ones.
        legend: False leaves out the legend below the axes.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.transforms import Affine2D

    ax = _axes(ax)
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
        ax.plot(*stored[:, :2].T, "x", color="#000000", ms=5, mew=1.2, label=_STORED, zorder=7)
    _poses(log, ax)

    everything = np.concatenate([known_corners(occupancy), log.true_pose[:, :2], log.goals[:, :2]])
    margin = 0.02 * float(np.ptp(everything, axis=0).max())
    ax.set_xlim(everything[:, 0].min() - margin, everything[:, 0].max() + margin)
    ax.set_ylim(everything[:, 1].min() - margin, everything[:, 1].max() + margin)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.set_title("Where it went")
    if legend:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=4)
    return ax


def plot_localisation(log: EpisodeLog, ax: Axes | None = None) -> Axes:
    """Distance between estimate and truth over time [cm], with dead reckoning where it fits into the picture."""
    ax = _axes(ax)
    error, _ = pose_errors(log.estimate, log.true_pose)
    odometry, _ = pose_errors(log.dead_reckoning, log.true_pose)
    ax.plot(log.time, 100.0 * error, color=css("estimate"), lw=1.2, label="estimate (lidar)")
    ax.plot(log.time, 100.0 * odometry, color=css("odometry"), lw=1.2, ls=":", label="wheel odometry alone")
    ax.set_ylim(0.0, 100.0 * max(1.3 * float(error.max()), 3.0 * float(error.mean()), 0.01))
    ax.set_ylabel("error [cm]")
    ax.set_title(f"Localisation error, {100.0 * error.mean():.1f} cm on average")
    if odometry.max() > error.max():
        ax.annotate(
            f"odometry ends {odometry[-1]:.2f} m off",
            xy=(0.995, 0.93), xycoords="axes fraction", ha="right", va="top", fontsize=8, color="#5b6472",
        )  # fmt: skip
    return _finish(log, ax)


def plot_controls(log: EpisodeLog, ax: tuple[Axes, Axes] | None = None) -> tuple[Axes, Axes]:
    """Forward and turning speed over time against their limits, in two axes."""
    first, second = (_axes(None), _axes(None)) if ax is None else ax
    names = (
        ("v [m/s]", "Forward speed and its limits"),
        ("$\\omega$ [rad/s]", "Turning speed and its limits"),
    )
    for axes, column, limit, (label, title) in zip((first, second), (0, 1), log.control_limits, names, strict=True):
        for bound in (-limit, limit):
            axes.axhline(bound, color=_LIMIT, lw=1.0, ls="--")
        axes.step(log.time, log.control[:, column], where="post", color=css("robot"), lw=1.1)
        axes.set_ylim(-1.18 * limit, 1.18 * limit)
        axes.set_ylabel(label)
        axes.set_title(title)
        _finish(log, axes)
    lowest = float(log.control[:, 0].min())
    if lowest >= 0.0:  # it never reversed: show the half that was used
        first.set_ylim(-0.08 * log.control_limits[0], 1.18 * log.control_limits[0])
    return first, second


def plot_clearance(log: EpisodeLog, ax: Axes | None = None) -> Axes:
    """Distance from the robot's hull to the nearest wall or obstacle over time [m]."""
    ax = _axes(ax)
    ax.fill_between(log.time, log.clearance, color=css("horizon"), alpha=0.18, lw=0)
    ax.plot(log.time, log.clearance, color=css("horizon"), lw=1.1)
    ax.axhline(0.0, color=css("moving"), lw=1.2)
    lowest = int(np.argmin(log.clearance))
    ax.plot(log.time[lowest], log.clearance[lowest], "v", color=css("horizon"), ms=6)
    finite = log.clearance[np.isfinite(log.clearance)]
    top = 1.15 * float(finite.max()) if finite.size else 1.0
    ax.set_ylim(min(0.0, 1.1 * float(log.clearance[lowest])) - 0.03 * top, top)
    ax.set_ylabel("clearance [m]")
    ax.set_title(f"Distance from hull to nearest thing, at least {max(0.0, log.clearance[lowest]):.2f} m")
    return _finish(log, ax)


def plot_solve_times(log: EpisodeLog, ax: Axes | None = None) -> Axes:
    """Time spent on estimation and on planning in each tick [ms]."""
    ax = _axes(ax)
    ax.plot(log.time, log.solve_ms, ".", color=css("plan"), ms=2.5, label="both")
    ax.plot(log.time, log.localise_ms, ".", color=css("estimate"), ms=1.8, label="localise")
    p50, p99 = np.percentile(log.solve_ms, [50.0, 99.0])
    for value in (p50, p99):
        ax.axhline(value, color=_LIMIT, lw=0.9, ls="--")
    ax.set_ylim(0.0, 1.25 * float(np.max(log.solve_ms)) + 1e-9)
    ax.set_ylabel("solve [ms]")
    ax.set_title(f"Solve time: median {p50:.1f} ms, 99 % within {p99:.0f} ms")
    ax.legend(loc="upper left", ncols=2, markerscale=3, borderpad=0.0)
    return _finish(log, ax)


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    return Figure(layout="constrained").subplots()


def _finish(log: EpisodeLog, ax: Axes) -> Axes:
    """Grid, the span of the episode, and marks on ticks that drove the stored plan."""
    ax.set_axisbelow(True)
    ax.grid(True)
    ax.set_xlim(log.time[0], log.time[-1] + log.dt)
    steps = np.diff(np.concatenate([[0], log.emergency.astype(np.int8), [0]]))
    for begin, end in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        ax.axvspan(log.time[begin], log.time[end - 1] + log.dt, color="#000000", alpha=0.12, lw=0)
    return ax


def _obstacles(log: EpisodeLog, ax: Axes) -> None:
    """Discs at their last place; those that move also at places passed, fading into the past."""
    from matplotlib.patches import Circle

    named: set[str] = set()
    for index, moves in enumerate(log.moving().tolist()):
        kind = "moving" if moves else "fixed"
        places = log.obstacles[:, index]
        shown = _apart(places) if moves else places[-1:]
        if moves:
            ax.plot(*places[:, :2].T, color=css(kind), lw=0.8, zorder=2)
        for rank, (x, y, radius) in enumerate(shown.tolist(), start=1):
            label = "unforeseen obstacle" if kind == "fixed" else "moving obstacle (fading into the past)"
            last = rank == len(shown)
            circle = Circle(
                (x, y), radius, facecolor=css(kind), edgecolor="none", zorder=2,
                alpha=0.95 if last else 0.1 + 0.3 * rank / len(shown),
            )  # fmt: skip
            if last and kind not in named:
                circle.set_label(label)
                named.add(kind)
            ax.add_patch(circle)


def _apart(places: Array) -> Array:
    """The last place and earlier ones at least 1.5 radii from all later ones kept, oldest first."""
    kept = [places[-1]]
    for place in places[-2::-1]:
        if np.linalg.norm(np.array(kept)[:, :2] - place[:2], axis=1).min() >= 1.5 * place[2]:
            kept.append(place)
    return np.array(kept[::-1])


def _poses(log: EpisodeLog, ax: Axes) -> None:
    """Start, goals and the robot where the episode ended, with short strokes for their headings."""
    from matplotlib.patches import Circle

    stroke = 0.03 * float(np.ptp(known_corners(log.occupancy), axis=0).max())
    named = [("start", log.start, "o", css("start"))]
    for index, goal in enumerate(log.goals):
        name = "goal" if len(log.goals) == 1 else f"goal {index + 1}"
        name += "" if log.reached[index] else " (missed)"
        named.append((name, goal, "*", css("goal")))
    for name, pose, marker, colour in named:
        x, y, heading = pose.tolist()
        ends = [x, x + stroke * np.cos(heading)], [y, y + stroke * np.sin(heading)]
        ax.plot(*ends, color="#1d2430", lw=1.4, zorder=8)
        ax.plot(x, y, marker, color=colour, ms=15 if marker == "*" else 8, mec="#1d2430", mew=0.8, zorder=9)
        ax.annotate(
            name, (x, y), xytext=(0, -9), textcoords="offset points", ha="center", va="top", fontsize=9,
            fontweight="bold",
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}, zorder=10,
        )  # fmt: skip
    x, y, _ = log.true_pose[-1].tolist()
    ax.add_patch(Circle((x, y), log.robot_radius, facecolor=css("robot"), edgecolor="white", lw=0.5, zorder=7))


def _title(log: EpisodeLog, metrics: dict[str, Any]) -> str:
    collisions = metrics["collisions"]
    hits = "no collision" if collisions == 0 else f"{collisions} collision" + ("s" if collisions > 1 else "")
    stopped = ", interrupted" if log.interrupted else ""
    return (
        f"{log.scenario} on {log.occupancy.name}: {metrics['goals_reached']} of {metrics['goals']} goals reached, "
        f"{hits}{stopped}  |  {metrics['path_length_m']:.1f} m in {metrics['duration_s']:.1f} s  |  "
        f"solver {log.solver} ({log.coupling}), seed {log.seed}"
    )
