"""A manoeuvre as one picture: every iterate on the plane, the controls against their limits, the way to convergence.

Colours follow Bazzana et al. 2022, Fig. 7: the guess is green, iterates are pink and whiten as they proceed, the
optimum is blue. Nothing is told by colour alone: the guess is dashed, the optimum thick, and marks carry labels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.scenarios.manoeuvres import Manoeuvre
from unifg.scenarios.scenes.panels import forbid, plot_convergence, shade_distance
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import discs, face, ground, headline, new_figure, word
from unifg.typing import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["picture", "plot_control", "plot_iterates", "plot_violation", "shades"]

_FIRST, _LAST = css("horizon"), css("robot")
_PINK, _WHITENED = np.array([0.84, 0.0, 0.42]), np.array([1.0, 0.86, 0.93])
_CUSP = css("fixed")
_REACH = 0.8  # [m]; how far from a disc the shading goes
_EVERY = 5  # nodes between two drawn robots
_STRAY = 0.6  # [m]; how far around the first and the last iterate the others are shown
_FLOOR = 1e-10  # smaller violations are drawn here


def picture(manoeuvre: Manoeuvre) -> Figure:
    """Iterates above; speed, turning speed and convergence below."""
    m = manoeuvre
    with new_figure((11.0, 8.0)) as figure:
        above, key, below = figure.subfigures(3, 1, height_ratios=(1.75, 0.28, 1.0), squeeze=False)[:, 0]
        place = plot_iterates(m, above.subplots())
        key.legend(*place.get_legend_handles_labels(), loc="center", ncols=3)
        speed, turning, convergence = below.subplots(1, 3)
        plot_control(m, 0, speed)
        plot_control(m, 1, turning)
        plot_violation(m, convergence)
        headline(figure, _title(m), 12.0)
    return figure


def plot_iterates(manoeuvre: Manoeuvre, ax: Axes) -> Axes:
    """Every iterate from the guess to the optimum, the robot along the optimum, and what stands in the way."""
    from matplotlib.patches import Polygon

    m = manoeuvre
    low, high = _extent(m)
    _discs(m, ax, low, high)

    colours = shades(len(m.iterates))
    middle = range(1, len(m.iterates) - 1)
    for number in middle:
        name = f"iterates 1 to {middle[-1]}, whitening" if number == 1 else None
        ax.plot(*m.iterates[number, :, :2].T, color=colours[number], lw=1.3, zorder=3, label=name)
    guess = m.iterates[0, :, :2].T
    ax.plot(*guess, color=_FIRST, lw=2.4, ls=(0, (4, 1.5)), zorder=5, label="first iterate: the guess, on the path")
    name = f"last iterate ({len(m.iterates) - 1}): the optimum"
    ax.plot(*m.states[:, :2].T, color=_LAST, lw=2.8, zorder=6, label=name)

    radius = m.settings.robot_radius
    for k in range(0, len(m.states), _EVERY):
        x, y, heading = m.states[k].tolist()
        discs(ax, [x, y, radius], fc=_LAST, ec=_LAST, alpha=0.13, lw=0, zorder=4)
        discs(ax, [x, y, radius], fill=False, ec=_LAST, alpha=0.5, lw=0.7, zorder=4)
        nose = radius * np.array([[0.95, 0.0], [0.4, 0.24], [0.4, -0.24]])
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        ax.add_patch(Polygon(nose @ turn.T + [x, y], fc="white", ec=INK, lw=1.0, zorder=7))
    name = f"front of the robot, every {_EVERY * m.settings.dt:g} s"
    ax.plot([], [], ">", color="white", mec=INK, ms=8, label=name)
    _marks(m, ax)

    ground(ax, low, high)
    return ax


def plot_control(manoeuvre: Manoeuvre, column: int, ax: Axes) -> Axes:
    """One control of the optimum over time against its limits; column 0 is v, column 1 is omega."""
    m = manoeuvre
    limit = m.settings.limits[column]
    ax.axhline(0.0, color=GREY, lw=0.8)
    forbid(ax, (-limit, limit), (-1.3 * limit, 1.3 * limit), m.time[-1])
    held = np.append(m.controls[:, column], m.controls[-1, column])
    ax.step(m.time, held, where="post", color=_LAST, lw=1.8)
    for k in m.cusps:
        ax.axvline(m.time[k], color=_CUSP, lw=1.8, ls="--")
        ax.annotate(
            f"cusp, {m.time[k]:.1f} s", (m.time[k], -limit), xytext=(5, 5), textcoords="offset points",
            fontsize=8.5, fontweight="bold",
        )  # fmt: skip
    for k in m.inflections:
        ax.axvline(m.time[k], color=INK, lw=1.0, ls=":")
    ax.set_ylim(-1.3 * limit, 1.3 * limit)
    ax.set_xlim(0.0, m.time[-1])
    title, label = (("Forward speed v", "v [m/s]"), ("Turning speed $\\omega$", "$\\omega$ [rad/s]"))[column]
    return face(ax, title, label, "time [s]")


def plot_violation(manoeuvre: Manoeuvre, ax: Axes) -> Axes:
    """Largest violation of every iterate, in the colours of the iterates, and how far from stationary it is."""
    history, tolerance = manoeuvre.solution.history, manoeuvre.settings.tolerance
    violation = np.maximum([row.violation for row in history], _FLOOR)
    # A guess that is the reference itself costs nothing: without multipliers it is stationary by accident.
    stationarity = [row.stationarity if row.stationarity > _FLOOR else np.nan for row in history]
    values = {"stationarity": stationarity, "violation": violation}
    shown: dict[str, dict[str, Any]] = {
        "stationarity": {"color": GREY, "ls": ":"},
        "violation": {"color": INK, "lw": 0.8, "zorder": 2, "label": "largest violation"},
    }
    plot_convergence(ax, history, shown, tolerance, lambda name: values[name])
    ax.scatter([row.number for row in history], violation, c=shades(len(history)), s=34, ec=INK, lw=0.6, zorder=3)
    ax.set_ylim(bottom=0.3 * _FLOOR)
    ax.legend(loc="upper right")
    return ax


def shades(count: int) -> Array:
    """(count, 3) colours of the iterates: green, then pink that whitens, then blue."""
    from matplotlib.colors import to_rgb

    share = np.sqrt(np.linspace(0.0, 1.0, max(count - 2, 1)))[:, None]  # the first ones differ most
    between = (1.0 - share) * _PINK + share * _WHITENED
    return np.concatenate([[to_rgb(_FIRST)], between[: max(count - 2, 0)], [to_rgb(_LAST)]])[:count]


def _extent(manoeuvre: Manoeuvre) -> tuple[Array, Array]:
    """Lower left and upper right corner of the picture; iterates that stray far are cut."""
    m = manoeuvre
    corners = np.array([[-1.0, -1.0], [1.0, 1.0]])
    discs = [np.array([x, y]) + radius * corners for x, y, radius in m.case.discs]
    shown = np.concatenate([m.iterates[0, :, :2], m.states[:, :2], *discs])
    low, high = shown.min(axis=0), shown.max(axis=0)
    strays = np.clip(m.iterates[:, :, :2].reshape(-1, 2), low - _STRAY, high + _STRAY)
    robot = m.settings.robot_radius
    return np.minimum(low - robot, strays.min(axis=0)) - 0.1, np.maximum(high + robot, strays.max(axis=0)) + 0.1


def _discs(manoeuvre: Manoeuvre, ax: Axes, low: Array, high: Array) -> None:
    """The discs, the ring that the robot's centre must not enter, and the distance to it as shading."""
    m = manoeuvre
    if not m.case.discs:
        return
    places = np.array(m.case.discs)
    kept = m.settings.robot_radius + m.settings.clearance

    def distance(points: Array) -> Array:
        offset = points[:, None] - places[:, :2]
        nearest: Array = (np.linalg.norm(offset, axis=2) - places[:, 2]).min(axis=1) - kept
        return nearest

    shade_distance(ax, low, high, distance, _REACH, "#b9c2cf")
    discs(ax, places, "unforeseen disc (ground: nearer is darker)", fc=css("fixed"), ec="none", zorder=1)
    rings = places + np.array([0.0, 0.0, kept])
    discs(ax, rings, "the robot's centre stays outside", fill=False, ec=INK, lw=1.1, ls=(0, (2, 2)), zorder=2)
    for x, y, radius in places.tolist():
        ax.text(x, y - 0.5 * radius, "unforeseen\ndisc", ha="center", va="center", fontweight="bold", zorder=6)


def _marks(manoeuvre: Manoeuvre, ax: Axes) -> None:
    """Start, end of the path, cusps and inflections, each with a word."""
    m = manoeuvre
    start, goal = m.states[0], m.case.reference(m.settings)[-1]
    ax.plot(*start[:2], "o", color=css("start"), ms=8, mec="white", mew=0.8, zorder=9)
    ax.plot(*goal[:2], "*", color=css("goal"), ms=17, mec=INK, mew=0.8, zorder=9)
    word(ax, start, "start", (0, 30))
    word(ax, goal, "goal", (0, 30))
    for k in m.cusps:
        name = "cusp: v passes through 0" if k == m.cusps[0] else None
        ax.plot(*m.states[k, :2], "D", color=_CUSP, ms=9, mec=INK, mew=1.0, zorder=10, label=name)
        forward = m.controls[k, 0] > 0.0
        ways = ("backward", "forward") if forward else ("forward", "backward")
        word(ax, m.states[k], f"cusp at {m.time[k]:.1f} s:\n{ways[0]} till here,\n{ways[1]} from here", (105, -14))
    for k in m.inflections:
        name = "inflection: $\\omega$ changes sign" if k == m.inflections[0] else None
        ax.plot(*m.states[k, :2], "s", color=INK, ms=6, mec="white", mew=1.0, zorder=8, label=name)


def _title(manoeuvre: Manoeuvre) -> str:
    m = manoeuvre
    ended = "optimum" if m.solution.converged else m.solution.status.name.lower().replace("_", " ")
    limits = "all limits kept" if m.within_limits else "a LIMIT BROKEN"
    return (
        f"{m.case.name}: {m.case.title}\n"
        f"{ended} after {m.solution.iterations} iterations of {m.solver}, cost {m.solution.cost:.4g}, {limits}"
    )
