"""Draw the pictures of the documentation: `python docs/images/draw.py` from an environment with unifg[scenarios].

The worked problem is the script of README.md, run here, so picture and script cannot part.
"""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parent.parent
sys.path[:0] = [str(CHECKOUT), str(CHECKOUT / "tests")]

from fences import fences  # noqa: E402
from unifg.lie import SE2  # noqa: E402
from unifg.models.lidar import in_world  # noqa: E402
from unifg.pose_graphs import manhattan  # noqa: E402
from unifg.scenarios.logs.drive_log import EpisodeLog  # noqa: E402
from unifg.scenarios.navigation import NavigationSettings, run_navigation  # noqa: E402
from unifg.solvers import GaussNewton  # noqa: E402
from unifg.style.colours import css  # noqa: E402
from unifg.typing import Array, IntArray  # noqa: E402

Point = tuple[float, float]
COST, HARD, GIVEN = "#ffffff", "#222222", "#d9d9d9"


def main() -> None:
    """Draw all pictures, or those named on the command line."""
    plt.rcParams.update({"font.size": 10, "font.family": "DejaVu Sans", "savefig.dpi": 130})
    pictures = {"worked-problem": worked_problem, "graphs": graphs, "joint": joint, "overview": overview}
    pictures |= {"bayes-tree": bayes_tree, "factor-graph": factor_graph, "solution": solution_plot}
    for name in sys.argv[1:] or pictures:
        pictures[name]().savefig(HERE / f"{name}.png", bbox_inches="tight", facecolor="white")


# ---------------------------------------------------------------- the worked problem of the README


def worked() -> dict[str, Any]:
    """Variables that the README's script leaves behind."""
    scope: dict[str, Any] = {}
    for block in fences(CHECKOUT / "README.md"):
        if block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(block.code, scope)
    return scope


def factor_graph() -> Any:
    """Its graph, as ``graph.draw()`` shows it."""
    return worked()["graph"].draw()


def solution_plot() -> Any:
    """Its solution, as ``solution.plot()`` shows it."""
    return worked()["solution"].plot()


def worked_problem() -> Any:
    """Past, present and future of the README's script."""
    scope = worked()
    poses, now = scope["solution"][scope["x"]], scope["now"]
    figure, ax = plt.subplots(figsize=(9.0, 3.7))
    ax.add_patch(Circle((1.9, 0.6), 0.4, color=css("fixed"), alpha=0.85, lw=0))
    ax.annotate("disc: keep out", (1.9, 0.6), ha="center", va="center", fontsize=9)
    ax.plot(*scope["fixes"].T, "x", color=css("scan"), ms=6, label="position fixes")
    ax.plot(*scope["truth"][:, :2].T, color=css("odometry"), lw=1.2, ls="--", label="true past")
    ax.plot(*poses[: now + 1, :2].T, "o-", color=css("estimate"), ms=3.5, lw=1.5, label="estimated past")
    ax.plot(*poses[now:, :2].T, "o-", color=css("horizon"), ms=3.0, lw=1.5, label="planned future")
    arrow(ax, poses[now], css("robot"), 0.22)
    ax.plot(*poses[now, :2], "o", color=css("robot"), ms=9)
    ax.annotate("now", place(poses[now]), (0, -16), textcoords="offset points", ha="center", color=css("robot"))
    ax.plot(3.0, 1.2, "*", color=css("goal"), ms=17, mec="#4d4d4d")
    ax.annotate("goal", (3.0, 1.2), (10, -4), textcoords="offset points")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-0.2, 3.4), ylim=(-0.15, 1.4))
    ax.legend(loc="upper left", frameon=False, fontsize=9)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


# ---------------------------------------------------------------- the two graphs of the scenario


def graphs() -> Any:
    """Localisation graph and control graph."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12.5, 4.6), gridspec_kw={"width_ratios": [1.0, 2.3]})
    localisation_graph(left)
    control_graph(right)
    return figure


def localisation_graph(ax: Axes) -> None:
    """One pose, one prior, many beams."""
    pose = (0.0, 0.0)
    factor(ax, [pose], (-1.35, 0.0), "odometry", COST, (0, 14))
    for angle in np.linspace(-75.0, 75.0, 7):
        at = (1.3 * float(np.cos(np.radians(angle))), 1.3 * float(np.sin(np.radians(angle))))
        factor(ax, [pose], at, "", COST)
    ax.annotate("lidar:\none for each\nof 360 beams", (1.5, 0.0), va="center", fontsize=9)
    variable(ax, pose, "$x$", css("estimate"))
    frame(ax, "Where am I?", (-2.2, 2.6), (-2.0, 2.2))


def control_graph(ax: Axes) -> None:
    """A chain of poses and controls."""
    stages = [(2.4 * k, 0.0) for k in range(4)]
    names = ["$x_0$", "$x_1$", "$x_2$", "$x_{30}$"]
    for k in range(3):
        middle = beside(stages[k], 1.2, 0.0)
        control = beside(middle, 0.0, -1.25)
        if k < 2:
            factor(ax, [stages[k], stages[k + 1], control], middle, "dynamics", HARD, (0, 9))
            factor(ax, [control], beside(control, 0.0, -0.8), "effort" if k == 0 else "", COST, (0, -16))
            factor(ax, [control], beside(control, -0.6, -0.55), "limits" if k == 0 else "", HARD, (-22, -14))
            variable(ax, control, f"$u_{k}$", css("robot"))
        else:
            ax.annotate("...", middle, ha="center", va="center", fontsize=20)
            ax.annotate("...", control, ha="center", va="center", fontsize=20)
    first, second = (1.2, -1.25), (3.6, -1.25)
    factor(ax, [first, second], (2.4, -1.25), "change", COST, (0, 9))
    factor(ax, [first], beside(first, -1.35, 0.0), "first change", COST, (0, 9))
    for k, stage in enumerate(stages[1:]):
        label = k == 0
        end = k == 2
        factor(ax, [stage], beside(stage, -0.7, 1.0), "end of path" if end else "path" if label else "", COST, (-6, 10))
        factor(ax, [stage], beside(stage, 0.0, 1.2), "margins" if label else "", COST, (0, 10))
        factor(ax, [stage], beside(stage, 0.7, 1.0), "walls, discs" if label else "", HARD, (14, 10))
    for stage, name in zip(stages, names, strict=True):
        variable(ax, stage, name, GIVEN if name == "$x_0$" else css("horizon"), dark=name == "$x_0$")
    ax.annotate("fixed to the\nestimate", stages[0], (0, 28), textcoords="offset points", ha="center", fontsize=9)
    ax.plot([], [], "s", ms=9, mfc=COST, mec=HARD, label="cost")
    ax.plot([], [], "s", ms=9, mfc=HARD, mec=HARD, label="hard constraint")
    ax.plot([], [], "o", ms=12, mfc=GIVEN, mec=HARD, label="given")
    ax.legend(loc="lower right", frameon=False, fontsize=9)
    frame(ax, "What should I do?", (-1.0, 8.6), (-2.6, 1.9))


# ---------------------------------------------------------------- the joint graph


def joint() -> Any:
    """Past and future around one present."""
    figure, ax = plt.subplots(figsize=(12.5, 4.2))
    places = [(2.1 * k, 0.0) for k in range(-3, 4)]
    names = ["$x_{-4}$", "...", "$x_{-1}$", "$x_0$", "$x_1$", "...", "$x_{30}$"]
    factor(ax, [places[0]], beside(places[0], -1.2, 0.0), "prior: what left\nthe window", COST, (0, 26))
    for k in (0, 1, 2):
        middle = beside(places[k], 1.05, 0.0)
        factor(ax, [places[k], places[k + 1]], middle, "odometry" if k == 2 else "", COST, (0, 12))
    for k in (0, 2, 3):
        for right in (-0.45, 0.0, 0.45):
            factor(ax, [places[k]], beside(places[k], right, 1.05), "lidar" if right == 0.0 else "", COST, (0, 14))
    for k in (3, 4, 5):
        middle = beside(places[k], 1.05, 0.0)
        control = beside(middle, 0.0, -1.15)
        if k == 4:
            ax.annotate("...", control, ha="center", va="center", fontsize=20)
            ax.plot([places[k][0], places[k + 1][0]], [0.0, 0.0], color="#666666", lw=1.2, zorder=1)
            continue
        factor(ax, [places[k], places[k + 1], control], middle, "dynamics" if k == 3 else "", HARD, (0, 12))
        factor(ax, [control], beside(control, -0.55, -0.5), "limits" if k == 3 else "", HARD, (-22, -8))
        factor(ax, [control], beside(control, 0.55, -0.5), "effort, change" if k == 3 else "", COST, (0, -14))
        variable(ax, control, "$u_0$" if k == 3 else "$u_{29}$", css("horizon"))
    for k in (4, 6):
        factor(ax, [places[k]], beside(places[k], -0.35, 1.0), "path, margins" if k == 4 else "", COST, (-14, 12))
        factor(ax, [places[k]], beside(places[k], 0.35, 1.0), "walls, discs" if k == 4 else "", HARD, (22, 12))
    for k, (place_, name) in enumerate(zip(places, names, strict=True)):
        if name == "...":
            ax.annotate(
                name, place_, ha="center", va="center", fontsize=20, bbox={"fc": "white", "ec": "none", "pad": 6}
            )
        else:
            variable(ax, place_, name, css("robot") if k < 3 else css("estimate") if k == 3 else css("horizon"))
    ax.annotate("past", beside(places[1], 0.0, -1.0), ha="center", color=css("robot"), fontsize=14)
    ax.annotate("present", beside(places[3], -0.2, -1.0), ha="center", color=css("estimate"), fontsize=14)
    ax.annotate("future", beside(places[5], 0.0, -2.2), ha="center", color=css("horizon"), fontsize=14)
    ax.plot([], [], "s", ms=9, mfc=COST, mec=HARD, label="cost")
    ax.plot([], [], "s", ms=9, mfc=HARD, mec=HARD, label="hard constraint")
    ax.legend(loc="lower left", frameon=False, fontsize=9)
    frame(ax, "Where am I, and what should I do?", (-8.4, 7.2), (-2.4, 2.0))
    return figure


def beside(point: Point, right: float, up: float) -> Point:
    """A point moved."""
    return point[0] + right, point[1] + up


def variable(ax: Axes, at: Point, name: str, colour: str, *, dark: bool = False) -> None:
    """A circle with a name."""
    ax.add_patch(Circle((at[0], at[1]), 0.32, fc=colour, ec=HARD, lw=1.0, zorder=3))
    ax.annotate(name, at, ha="center", va="center", color="black" if dark else "white", fontsize=12, zorder=4)


def factor(ax: Axes, ends: list[Point], at: Point, name: str, colour: str, offset: Point = (0.0, 12.0)) -> None:
    """A square joined to its variables."""
    for end in ends:
        ax.plot([at[0], end[0]], [at[1], end[1]], color="#666666", lw=1.2, zorder=1)
    ax.add_patch(Rectangle((at[0] - 0.12, at[1] - 0.12), 0.24, 0.24, fc=colour, ec=HARD, lw=1.2, zorder=2))
    if name:
        ax.annotate(name, at, offset, textcoords="offset points", ha="center", va="center", fontsize=9)


def frame(ax: Axes, title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Equal axes without ticks."""
    ax.set(aspect="equal", xlim=x, ylim=y)
    ax.set_title(title, fontsize=13)
    ax.axis("off")


# ---------------------------------------------------------------- the demonstration


def overview() -> Any:
    """The whole way on the map, and one moment beside an obstacle."""
    log = run_navigation(NavigationSettings(coupling="joint", obstacles=3, seed=0))
    if not log.succeeded:
        raise SystemExit("the demonstration did not reach its goals: no picture of that")
    index = int(np.flatnonzero(~log.obstacle_moves)[-1])  # shown from near; a standing disc needs no prediction
    gap = np.hypot(*(log.true_pose[:, :2] - log.obstacles[:, index, :2]).T) - log.obstacles[:, index, 2]
    tick = int(np.argmin(np.where(gap > 0.9, gap, np.inf)[: int(gap.argmin())]))
    figure, (whole, near) = plt.subplots(1, 2, figsize=(13.0, 5.9), gridspec_kw={"width_ratios": [1.32, 1.0]})
    x, y = log.true_pose[tick, :2] + 0.5 * (log.horizon[tick][-1] - log.horizon[tick][0])[:2]
    view = (float(x), float(y), 2.4)
    whole_way(whole, log, view)
    one_moment(near, log, tick, view)
    labelled = [axes.get_legend_handles_labels() for axes in (whole, near)]
    handles, labels = (first + second for first, second in zip(*labelled, strict=True))
    figure.subplots_adjust(wspace=0.03, bottom=0.1)
    figure.legend(handles, labels, loc="lower center", ncol=4, frameon=False, fontsize=10)
    return figure


def whole_way(ax: Axes, log: EpisodeLog, view: tuple[float, float, float]) -> None:
    """Map, planned path, the way driven, dead reckoning."""
    walls(ax, log)
    ax.plot(
        *log.dead_reckoning[:, :2].T,
        color=css("odometry"),
        lw=1.4,
        ls="--",
        label="where the wheels alone would put it",
    )
    ax.plot(*log.path[:, :2].T, color=css("plan"), lw=1.0, ls=":", label="planned path")
    ax.plot(*log.true_pose[:, :2].T, color=css("trail"), lw=2.4, label="driven")
    discs(ax, log, log.ticks - 1)
    ax.plot([], [], "o", color=css("fixed"), label="not on the map, standing")
    ax.plot([], [], "o", color=css("moving"), label="not on the map, moving")
    ax.plot(*log.start[:2], "o", color=css("robot"), ms=9)
    ax.annotate("start", place(log.start), (0, 11), textcoords="offset points", ha="center")
    for number, goal in enumerate(log.goals, 1):
        ax.plot(*goal[:2], "*", color=css("goal"), ms=18, mec="#4d4d4d")
        ax.annotate(f"goal {number}", place(goal), (0, -20), textcoords="offset points", ha="center")
    x, y, half = view
    ax.add_patch(Rectangle((x - half, y - half), 2 * half, 2 * half, fill=False, ec=css("scan"), lw=1.6, zorder=6))
    ax.set(aspect="equal", xlim=limits(log, 0), ylim=limits(log, 1))
    ax.set_title(f"{log.ticks * log.dt:.0f} seconds through a building", fontsize=12)
    ax.axis("off")


def one_moment(ax: Axes, log: EpisodeLog, tick: int, view: tuple[float, float, float]) -> None:
    """Lidar, tracked discs and the predicted plan at one tick."""
    walls(ax, log)
    x, y, half = view
    pose, estimate = log.true_pose[tick], log.estimate[tick]
    seen = np.isfinite(log.scan[tick])
    ranges, angles = log.scan[tick][seen], log.scan_angles[seen]
    ends = in_world(estimate[None], np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1))
    for end in ends[::3]:
        ax.plot([estimate[0], end[0]], [estimate[1], end[1]], color=css("scan"), lw=0.4, alpha=0.25, zorder=2)
    ax.plot(*log.path[:, :2].T, color=css("plan"), lw=1.2, ls=":", zorder=3)
    discs(ax, log, tick)
    ax.plot(*ends.T, ".", color=css("scan"), ms=4.5, zorder=5, label="lidar end-points, placed by the estimate")
    for cx, cy, radius in log.detected[tick]:
        ax.add_patch(Circle((cx, cy), radius, fill=False, ec=css("detected"), lw=1.6, ls="--", zorder=6))
    ax.plot(*log.true_pose[: tick + 1, :2].T, color=css("trail"), lw=2.4, zorder=3)
    ax.plot(
        *log.horizon[tick][:, :2].T, "o-", color=css("horizon"), ms=3.2, lw=1.4, zorder=5, label="plan for the next 3 s"
    )
    ax.add_patch(Circle((pose[0], pose[1]), log.robot_radius, color=css("robot"), zorder=6))
    arrow(ax, pose, "white", 0.13)
    ax.plot([], [], "--", color=css("detected"), label="disc the robot has found")
    ax.set(aspect="equal", xlim=(x - half, x + half), ylim=(y - half, y + half), xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set(color=css("scan"), linewidth=1.6)
    ax.set_title("One tick, one graph: where am I, what should I do?", fontsize=12)


def walls(ax: Axes, log: EpisodeLog) -> None:
    """Occupied and free cells."""
    occupancy = log.occupancy
    height, width = occupancy.shape
    picture = np.ones((height, width, 3))
    for cells, name in ((occupancy.free, "floor"), (occupancy.occupied, "wall")):
        picture[cells] = [int(css(name)[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    corner = occupancy.grid_to_world(np.array([[0.0, 0.0], [float(width), float(height)]]))
    ax.imshow(
        picture,
        origin="lower",
        extent=(corner[0, 0], corner[1, 0], corner[0, 1], corner[1, 1]),
        interpolation="nearest",
    )


def discs(ax: Axes, log: EpisodeLog, tick: int) -> None:
    """True obstacles at one tick."""
    for (x, y, radius), moving in zip(log.obstacles[tick], log.obstacle_moves, strict=True):
        ax.add_patch(Circle((x, y), radius, color=css("moving" if moving else "fixed"), zorder=4))


def limits(log: EpisodeLog, axis: int) -> tuple[float, float]:
    """Limits of the occupied area along an axis, with a margin of 0.3 m."""
    cells = np.argwhere(log.occupancy.occupied)[:, ::-1]
    corners = log.occupancy.grid_to_world(np.stack([cells.min(axis=0), cells.max(axis=0) + 1]).astype(np.float64))
    return float(corners[0, axis] - 0.3), float(corners[1, axis] + 0.3)


def place(pose: Array) -> Point:
    """Position of a pose."""
    return float(pose[0]), float(pose[1])


def arrow(ax: Axes, pose: Array, colour: str, length: float) -> None:
    """A stroke along the heading."""
    tip = SE2.compose(pose, np.array([length, 0.0, 0.0]))
    ax.plot([pose[0], tip[0]], [pose[1], tip[1]], color=colour, lw=2.2, zorder=7, solid_capstyle="round")


# ---------------------------------------------------------------- elimination


def bayes_tree() -> Any:
    """A small pose graph and the tree in which the engine eliminates it, cliques coloured alike on both sides."""
    city = manhattan(60, seed=4, block=4)
    pose_graph = city.pose_graph
    graph, x, guess = pose_graph.graph()
    poses = GaussNewton().solve(graph, guess)[x]
    tree = graph.elimination_tree()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.6), width_ratios=[1.0, 1.35])
    colours = plt.get_cmap("viridis")(np.linspace(0.05, 0.95, len(tree)))
    for i, j in zip(pose_graph.edges.first, pose_graph.edges.second, strict=True):
        left.plot(poses[[i, j], 0], poses[[i, j], 1], color="#9a9a9a", lw=1.2, zorder=1)
    left.plot(poses[0, 0], poses[0, 1], "s", color="#222222", ms=8, zorder=3)
    left.annotate("fixed", poses[0, :2], xytext=(6, 6), textcoords="offset points")
    place = _places(tree.parent)
    for s in range(len(tree)):
        members = [int(tree.names[k].split("[")[1][:-1]) for k in tree.nodes(s)]
        left.plot(*poses[members, :2].T, "o", color=colours[s], ms=7, mec="black", mew=0.4, zorder=2)
        at, below = place[s], int(tree.parent[s])
        if below >= 0:
            right.plot([at[0], place[below][0]], [at[1], place[below][1]], color="#9a9a9a", lw=1.2, zorder=1)
        label = ",".join(map(str, sorted(members)))
        ink = "white" if s < 0.6 * len(tree) else "black"
        right.annotate(
            label, at, ha="center", va="center", fontsize=7.5, zorder=2, color=ink,
            bbox={"boxstyle": "round,pad=0.25", "fc": colours[s], "ec": "black", "lw": 0.5},
        )  # fmt: skip
    left.set_title("Pose graph: loop closures tie the streets together")
    left.set_aspect("equal")
    left.set_xlabel("x [m]")
    left.set_ylabel("y [m]")
    right.set_title("Its Bayes tree: leaves are eliminated first, the root last")
    right.axis("off")
    right.margins(0.06)
    figure.tight_layout()
    return figure


def _places(parent: IntArray) -> dict[int, Point]:
    """Positions of the nodes of a tree: leaves side by side, parents above the middle of their children."""
    children: dict[int, list[int]] = {s: [] for s in range(-1, len(parent))}
    for s in range(len(parent)):
        children[int(parent[s])].append(s)
    place: dict[int, Point] = {}
    column = [0.0]

    def put(s: int, depth: int) -> None:
        for child in children[s]:
            put(child, depth + 1)
        if children[s]:
            across = float(np.mean([place[child][0] for child in children[s]]))
        else:
            across = column[0]
            column[0] += 1.0
        place[s] = across, -float(depth)

    for root in children[-1]:
        put(root, 0)
    return place


if __name__ == "__main__":
    main()
