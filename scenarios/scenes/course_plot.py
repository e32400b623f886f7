"""An optimised flight as one picture: chosen iterates from above and in space, cost and violation of all of them.

After Ta et al. 2014, Fig. 3, drawn as in the scene of the iterates; the quadrotor stands at the start and, in the last
row, along its way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.plots.descent import draw_cost, draw_errors
from unifg.scenarios.course import Course
from unifg.scenarios.scenes.course_scene import HEIGHT, iterate_scene
from unifg.scenarios.scenes.panels import shade_distance
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import face, ground, headline, key_of, new_figure
from unifg.typing import Array, Axes, Figure

__all__ = ["chosen_iterates", "picture", "plot_above", "plot_space"]

_WAY = css("horizon")
_GUESSES = {"hover": "stay at the start", "line": "straight to the target", "way": "a shortest way"}
_BESIDE = 0.5  # around the last iterate [m]
_REACH = 1.2  # how far from the hull the shading goes [m]
_FLOOR = 1e-12  # smaller violations are drawn here
_TITLES = {
    "cost": "What each iterate would cost",
    "violation": "Largest violation of dynamics, limits and clearance",
}


def picture(course: Course) -> Figure:
    """Four iterates, each from above and in space; below them cost and violation of all."""
    c = course
    chosen = chosen_iterates(len(c.iterates))
    with new_figure((11.0, 3.0 * len(chosen) + 4.0)) as figure:
        above, key, below = figure.subfigures(3, 1, height_ratios=(3.0 * len(chosen), 0.6, 2.6), squeeze=False)[:, 0]
        left, right = above.subfigures(1, 2, width_ratios=(1.0, 1.1), squeeze=False)[0]
        tops = left.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
        spaces = right.subplots(len(chosen), 1, subplot_kw={"projection": "3d"}, squeeze=False)[:, 0]
        for row, number in enumerate(chosen):
            plot_above(c, number, tops[row])
            plot_space(c, number, spaces[row])
        spaces[0].set_title("The same in space; grey: below it on the ground", y=1.0)
        key.legend(*key_of(tops), loc="center", ncols=4)
        history = c.solution.history
        values = {"cost": history.column("cost"), "violation": np.maximum(history.column("violation"), _FLOOR)}
        cost, violation = below.subplots(1, 2)
        draw_cost(cost, values["cost"], _TITLES["cost"])
        draw_errors(violation, {"violation": values["violation"]})
        for ax, (what, shown) in zip((cost, violation), values.items(), strict=True):
            ax.plot(chosen, shown[chosen], "o", color=_WAY, ms=8, mec=INK, mew=0.8, label="iterates shown above")
            ax.legend(loc="best")
            face(ax, _TITLES[what], x="iterate")
        headline(figure, _title(c), 11.0)
    return figure


def chosen_iterates(count: int) -> list[int]:
    """At most four of ``count`` iterates: the guess, the first step, one of the middle, and the last."""
    last = count - 1
    return sorted({0, min(1, last), min(max(2, round(last / 3)), last), last})


def plot_above(course: Course, number: int, ax: Axes) -> Axes:
    """One iterate from above, with the nodes at which its hull would touch something."""
    nodes, low, high = course.iterates[number], *_extent(course)
    x, y, gap = shade_distance(ax, low, high, lambda p: course.layout.distance(p) - VEHICLE_RADIUS, _REACH, "#cfd6df")
    ax.contour(x, y, gap, levels=[0.0], colors=[GREY], linewidths=0.9, linestyles=[(0, (2, 2))], zorder=1)
    ax.plot([], [], color=GREY, lw=0.9, ls=(0, (2, 2)), label="centre inside this line: the hull touches")
    scene = iterate_scene(course, number)
    scene.points("nodes", nodes[:, :3], pixels=4.0, colour="horizon", legend="")
    hits = course.layout.distance(nodes[:, :2]) < VEHICLE_RADIUS - 1e-3  # by more than rounding
    if hits.any():
        scene.points("hits", nodes[hits, :3], colour="fixed", legend="node where the hull would touch")
    scene.draw(ax)
    ground(ax, low, high)
    ax.set_title(_caption(course, number))
    ax.label_outer()
    return ax


def plot_space(course: Course, number: int, ax: Any) -> Any:
    """One iterate in space, on three-dimensional axes."""
    scene, way = iterate_scene(course, number), course.iterates[number][:, :3]
    scene.way("below", way * [1.0, 1.0, 0.0], colour="odometry", legend="")
    scene.draw(ax)
    (left, low), (right, high) = _extent(course).tolist()
    ax.set(xlim=(left, right), ylim=(low, high), zlim=(0.0, HEIGHT))
    ax.set_box_aspect((right - left, high - low, 1.4 * HEIGHT), zoom=1.6)
    ax.view_init(elev=32.0, azim=-68.0)
    ax.set_axis_off()
    for artist in (*ax.lines, *ax.collections):
        artist.set_clip_on(False)  # the square of these axes is smaller than the room they have
        artist.set_in_layout(False)
    return ax


def _extent(course: Course) -> Array:
    """(2, 2) lowest and highest corner of the ground shown [m]: the layout's, and the last iterate's."""
    low, high = course.layout.size
    way = course.states[:, :2]
    return np.stack([np.minimum(low, way.min(axis=0) - _BESIDE), np.maximum(high, way.max(axis=0) + _BESIDE)])


def _caption(course: Course, number: int) -> str:
    last = len(course.iterates) - 1
    cost = course.solution.cost if number == last else course.solution.history[number].cost
    what = {0: f", the guess: {_GUESSES[course.settings.guess]}", last: ", the last"}.get(number, "")
    return f"Iterate {number}{what}; cost {cost:.4g}"


def _title(course: Course) -> str:
    c, s = course, course.settings
    clear = f"hull clear by {c.clearance_between:.2f} m" if c.clear else "in COLLISION"
    ended = c.solution.status.name.lower().replace("_", " ")
    kept = "repelled by 1/d" if s.avoidance == "potential" else f"kept {s.clearance:g} m clear"
    return (
        f"A quadrotor is to fly to the yellow target, {kept} of three walls and a cylinder\n"
        f"{c.layout.name}, {s.solver} with the {s.hessian} Hessian: {ended} after {c.solution.iterations} "
        f"iterations, {c.target_distance:.2f} m from the target, {clear}"
    )
