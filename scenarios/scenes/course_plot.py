"""An optimised flight as one picture: chosen iterates from above and in space, cost and violation of all of them.

After Ta et al. 2014, Fig. 3: walls are grey, the cylinder blue, the target dark red, and the quadrotor is four red
circles, at the start and, in the last row, along its way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.lie import SO3
from unifg.scenarios.course import Course
from unifg.scenarios.scenes.panels import shade_distance
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import discs, face, ground, headline, key_of, new_figure, word
from unifg.typing import Array, BoolArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["chosen_iterates", "picture", "plot_above", "plot_numbers", "plot_space"]

_WALL, _CYLINDER, _TARGET, _ROTORS, _WAY = css("wall"), css("trail"), "#7a0d12", css("moving"), css("horizon")
_HIT = css("fixed")
_HEIGHT = 2.0  # up to which obstacles are drawn; they have no top [m]
_ARM, _DISC = 0.64 * VEHICLE_RADIUS, 0.36 * VEHICLE_RADIUS  # to a rotor's axis, and its radius [m]
_APART = 0.75  # two quadrotors are drawn at least so far apart [m]
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
        spaces[0].set_title("The same in space; dashed: below it on the ground", y=1.0)
        key.legend(*key_of(tops), loc="center", ncols=4)
        cost, violation = below.subplots(1, 2)
        plot_numbers(c, "cost", cost)
        plot_numbers(c, "violation", violation)
        headline(figure, _title(c), 11.0)
    return figure


def chosen_iterates(count: int) -> list[int]:
    """At most four of ``count`` iterates: the guess, the first step, one of the middle, and the last."""
    last = count - 1
    return sorted({0, min(1, last), min(max(2, round(last / 3)), last), last})


def plot_above(course: Course, number: int, ax: Axes) -> Axes:
    """One iterate from above, with the nodes at which its hull would touch something."""
    c, nodes = course, course.iterates[number]
    final = number == len(c.iterates) - 1
    _shading(c, ax)
    for index, wall in enumerate(c.layout.walls):
        name = "wall" if index == 0 else None
        ax.plot(*wall.T, color=_WALL, lw=5.0, solid_capstyle="round", zorder=3, label=name)
    discs(ax, c.layout.cylinders, "cylinder", fc=_CYLINDER, ec=INK, lw=0.8, zorder=3)
    ax.plot(*c.layout.target[:2], "o", color=_TARGET, ms=11, mec="white", mew=0.8, zorder=6, label="target")
    ax.plot(*nodes[:, :2].T, color=_WAY, lw=2.0, marker=".", ms=4, zorder=5, label="planned way and its nodes")
    hits = _hits(c, nodes)
    if hits.any():
        ax.plot(*nodes[hits, :2].T, "x", color=_HIT, ms=6, mew=2.0, zorder=9, label="node where the hull would touch")
    for index, node in enumerate(_drawn(nodes) if final else nodes[:1]):
        for ring in _rotors(node):
            ax.fill(*ring[:, :2].T, fc=_ROTORS, ec="#7a120b", lw=0.5, alpha=0.9, zorder=8)
        if index == 0:
            ax.plot([], [], "o", color=_ROTORS, ms=6, label="quadrotor: four rotors, to scale")
    if number == 0:
        for place, name in ((c.layout.start, "start"), (c.layout.target, "target")):
            word(ax, place, name, (0, -9), va="top", bbox=None)
    ground(ax, *_extent(c))
    ax.set_title(_caption(c, number))
    ax.label_outer()
    return ax


def plot_space(course: Course, number: int, ax: Any) -> Any:
    """One iterate in space, on three-dimensional axes."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    c = course
    final = number == len(c.iterates) - 1
    (left, low), (right, high) = _extent(c).tolist()
    floor = [[[left, low, 0.0], [right, low, 0.0], [right, high, 0.0], [left, high, 0.0]]]
    ax.add_collection3d(Poly3DCollection(floor, fc="#f6f4ef", ec="#d5d3cc", lw=0.8, zorder=0))
    lines = [[[x, low, 0.0], [x, high, 0.0]] for x in np.arange(np.ceil(left), right)]
    lines += [[[left, y, 0.0], [right, y, 0.0]] for y in np.arange(np.ceil(low), high)]
    for line in lines:
        ax.plot(*np.transpose(line), color="#e2dfd6", lw=0.6, zorder=1)

    way = np.where(_within(c, c.iterates[number][:, :3])[:, None], c.iterates[number][:, :3], np.nan)
    ax.plot(way[:, 0], way[:, 1], 0.0, color=GREY, lw=1.2, ls=(0, (2, 1.5)), zorder=2)  # its shadow
    # From the back to the front, because these axes hide nothing behind anything by themselves.
    places = [(float(wall[:, 1].mean()), "wall", wall) for wall in c.layout.walls]
    places += [(float(y), "cylinder", np.array([x, y, r])) for x, y, r in c.layout.cylinders.tolist()]
    for order, (_, kind, place) in enumerate(sorted(places, key=lambda entry: -entry[0])):
        faces, colour = _sheet(place) if kind == "wall" else _barrel(place), _WALL if kind == "wall" else _CYLINDER
        edge = "#5c6570" if kind == "wall" else "none"
        ax.add_collection3d(Poly3DCollection(faces, fc=colour, ec=edge, lw=0.8, alpha=0.55, zorder=3 + order))
    ax.plot(*way.T, color=_WAY, lw=2.2, zorder=20)
    for node in _drawn(c.iterates[number]) if final else c.iterates[number][:1]:
        ax.add_collection3d(Poly3DCollection(_rotors(node), fc=_ROTORS, ec="#7a120b", lw=0.4, alpha=0.9, zorder=22))
    ax.plot(*c.layout.target[:, None], "o", color=_TARGET, ms=9, mec="white", mew=0.7, zorder=21)
    ax.plot(*np.column_stack([c.layout.target, [*c.layout.target[:2], 0.0]]), color=_TARGET, lw=0.9, zorder=19)
    ax.set(xlim=(left, right), ylim=(low, high), zlim=(0.0, _HEIGHT))
    ax.set_box_aspect((right - left, high - low, 1.4 * _HEIGHT), zoom=1.6)
    ax.view_init(elev=32.0, azim=-68.0)
    ax.computed_zorder = False
    ax.set_axis_off()
    for artist in (*ax.lines, *ax.collections):
        artist.set_clip_on(False)  # the square of these axes is smaller than the room they have
        artist.set_in_layout(False)
    return ax


def plot_numbers(course: Course, what: str, ax: Axes) -> Axes:
    """The "cost" or the largest "violation" of every iterate; those drawn above are marked."""
    from matplotlib.ticker import MaxNLocator

    history = course.solution.history
    values = np.array([getattr(row, what) for row in history])
    if what == "violation":
        values = np.maximum(values, _FLOOR)
    chosen = chosen_iterates(len(history))
    ax.plot(values, color=INK, lw=1.2, marker=".", ms=5)
    ax.plot(chosen, values[chosen], "o", color=_WAY, ms=8, mec=INK, mew=0.8, label="iterates shown above")
    if (values > 0.0).all() and values.max() > 10.0 * values.min():
        _logarithmic(ax, wide=values.max() > 1e4 * values.min())
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(loc="best")
    return face(ax, _TITLES[what], x="iterate")


def _logarithmic(ax: Axes, *, wide: bool) -> None:
    """A logarithmic axis, with plain numbers where few powers of ten are shown."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    ax.set_yscale("log")
    if not wide:
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.yaxis.set_minor_formatter(NullFormatter())


def _rotors(node: Array) -> list[Array]:
    """Four circles (n, 3) in the plane of the rotors of a state (10,)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 17)
    rim = _DISC * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    corners = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    hubs = _ARM * np.column_stack([np.cos(corners), np.sin(corners), np.zeros(4)])
    turn = SO3.to_matrix(node[3:7])
    return [(hub + rim) @ turn.T + node[:3] for hub in hubs]


def _drawn(nodes: Array) -> Array:
    """Nodes far enough apart to draw a quadrotor at each, first and last among them."""
    kept = [nodes[0]]
    for node in nodes[1:]:
        if np.linalg.norm(node[:3] - kept[-1][:3]) >= _APART:
            kept.append(node)
    if np.linalg.norm(nodes[-1, :3] - kept[-1][:3]) > 0.5 * _APART or len(kept) == 1:
        kept.append(nodes[-1])
    return np.array(kept)


def _hits(course: Course, nodes: Array) -> BoolArray:
    """(n,) True where the hull touches something by more than rounding."""
    hits: BoolArray = course.layout.distance(nodes[:, :2]) < VEHICLE_RADIUS - 1e-3
    return hits


def _extent(course: Course) -> Array:
    """(2, 2) lowest and highest corner of the ground shown [m]: the layout's, and the last iterate's."""
    low, high = course.layout.size
    way = course.states[:, :2]
    return np.stack([np.minimum(low, way.min(axis=0) - _BESIDE), np.maximum(high, way.max(axis=0) + _BESIDE)])


def _within(course: Course, points: Array) -> BoolArray:
    """(n,) True inside the picture; lines in space are not clipped by themselves."""
    low, high = _extent(course)
    inside: BoolArray = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1) & (points[:, 2] <= 2.0 * _HEIGHT)
    return inside


def _shading(course: Course, ax: Axes) -> None:
    """The ground, the darker the nearer the hull would be to something, and where it would touch."""
    low, high = _extent(course)
    x, y, gap = shade_distance(ax, low, high, lambda p: course.layout.distance(p) - VEHICLE_RADIUS, _REACH, "#cfd6df")
    ax.contour(x, y, gap, levels=[0.0], colors=[GREY], linewidths=0.9, linestyles=[(0, (2, 2))], zorder=1)
    ax.plot([], [], color=GREY, lw=0.9, ls=(0, (2, 2)), label="centre inside this line: the hull touches")


def _sheet(wall: Array) -> list[Array]:
    low, high = (np.column_stack([wall, np.full(2, z)]) for z in (0.0, _HEIGHT))
    return [np.concatenate([low, high[::-1]])]


def _barrel(cylinder: Array) -> list[Array]:
    x, y, radius = cylinder.tolist()
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    low = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.zeros_like(angle)])
    high = low + np.array([0.0, 0.0, _HEIGHT])
    return [*(np.stack([low[k], low[k + 1], high[k + 1], high[k]]) for k in range(24)), high]


def _caption(course: Course, number: int) -> str:
    last = len(course.iterates) - 1
    cost = course.solution.cost if number == last else course.solution.history[number].cost
    what = {0: f", the guess: {_GUESSES[course.settings.chosen_guess]}", last: ", the last"}.get(number, "")
    return f"Iterate {number}{what}; cost {cost:.4g}"


def _title(course: Course) -> str:
    c, s = course, course.settings
    clear = f"hull clear by {c.clearance_between:.2f} m" if c.clear else "in COLLISION"
    ended = c.solution.status.name.lower().replace("_", " ")
    kept = "repelled by 1/d" if s.avoidance == "potential" else f"kept {s.clearance:g} m clear"
    return (
        f"A quadrotor is to fly to the dark red target, {kept} of three walls and a cylinder\n"
        f"{c.layout.name}, {s.solver} with the {s.chosen_hessian} Hessian: {ended} after {c.solution.iterations} "
        f"iterations, {c.target_distance:.2f} m from the target, {clear}"
    )
