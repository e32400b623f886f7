"""A manoeuvre as one picture: every iterate on the plane, the controls against their limits, the way to convergence.

Colours follow Bazzana et al. 2022, Fig. 7: the guess is green, iterates are pink and whiten as they proceed, the
optimum is blue. Nothing is told by colour alone: the guess is dashed, the optimum thick, and marks carry labels.
"""

from __future__ import annotations

import numpy as np

from unifg.plots.descent import draw_errors
from unifg.scenarios.manoeuvres import Manoeuvre
from unifg.scenarios.scenes.panels import plot_held, shade_distance
from unifg.style.colours import INK, css
from unifg.style.figures import face, ground, headline, new_figure
from unifg.typing import Array, Axes, Figure
from unifg.view import Scene
from unifg.view.bodies import Part, body_of
from unifg.view.shapes import merge, ring, wedge

__all__ = ["picture", "plot_control", "plot_iterates", "plot_violation", "shades"]

_FIRST, _LAST = css("horizon"), css("robot")
_PINK, _WHITENED = np.array([0.84, 0.0, 0.42]), np.array([1.0, 0.86, 0.93])
_CUSP = css("fixed")
_REACH = 0.8  # [m]; how far from a disc the shading goes
_EVERY = 5  # nodes between two drawn robots
_ABOVE = 1.0  # height of marks, which nothing hides [m]
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
    from matplotlib.colors import to_hex

    m, last = manoeuvre, len(manoeuvre.iterates) - 1
    low, high = _extent(m)
    scene = Scene()
    _discs(m, scene, ax, low, high)
    width = 0.004 * float((high - low).max())
    for number, colour in enumerate(map(to_hex, shades(last + 1)[1:]), start=1):
        name = f"last iterate ({last}): the optimum" if number == last else f"iterates 1 to {last - 1}, whitening"
        size = 1.6 * width if number == last else 0.8 * width
        scene.way(f"iterate {number}", m.iterates[number, :, :2], width=size, colour=colour, legend=name)
    guess, dashed = m.iterates[0, :, :2].T, (0, (4, 1.5))
    ax.plot(*guess, color=_FIRST, lw=2.4, ls=dashed, zorder=2.1, label="first iterate: the guess, on the path")
    frame = scene.frame()
    name = f"robot and its front, every {_EVERY * m.settings.dt:g} s"
    for k in range(0, len(m.states), _EVERY):
        faint = [part._replace(opacity=0.13) for part in body_of("disc", m.settings.robot_radius, "robot")[:1]]
        nose = Part("front", wedge(0.5 * m.settings.robot_radius, 0.3), "ink", False)
        scene.body(f"robot {k}", [*faint, nose], colour="robot", legend=name)
        frame.place(f"robot {k}", m.states[k])
    _marks(m, scene)
    scene.draw(ax)
    ground(ax, low, high)
    return ax


def plot_control(manoeuvre: Manoeuvre, column: int, ax: Axes) -> Axes:
    """One control of the optimum over time against its limits; column 0 is v, column 1 is omega."""
    m, limit = manoeuvre, manoeuvre.settings.limits[column]
    title, label = (("Forward speed v", "v [m/s]"), ("Turning speed $\\omega$", "$\\omega$ [rad/s]"))[column]
    plot_held(ax, m.time, m.controls[:, column], (-limit, limit), title, label, "control")
    for k in m.cusps:
        ax.axvline(m.time[k], color=_CUSP, lw=1.8, ls="--")
        ax.annotate(
            f"cusp, {m.time[k]:.1f} s", (m.time[k], -limit), xytext=(5, 5), textcoords="offset points",
            fontsize=8.5, fontweight="bold",
        )  # fmt: skip
    for k in m.inflections:
        ax.axvline(m.time[k], color=INK, lw=1.0, ls=":")
    ax.set_xlabel("time [s]")
    return ax


def plot_violation(manoeuvre: Manoeuvre, ax: Axes) -> Axes:
    """Largest violation of every iterate, in the colours of the iterates, and how far from stationary it is."""
    history = manoeuvre.solution.history
    errors = {name: np.maximum(history.column(name), _FLOOR) for name in ("stationarity", "violation")}
    # A guess that is the reference itself costs nothing: without multipliers it is stationary by accident.
    errors["stationarity"][errors["stationarity"] == _FLOOR] = np.nan
    draw_errors(ax, errors, manoeuvre.settings.tolerance)
    numbers, violation = np.arange(len(history)), errors["violation"]
    ax.scatter(numbers, violation, c=shades(len(history)), s=34, ec=INK, lw=0.6, zorder=3)
    ax.set_ylim(bottom=0.3 * _FLOOR)
    return face(ax, "What is wrong with each iterate", x="iterate")


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


def _discs(manoeuvre: Manoeuvre, scene: Scene, ax: Axes, low: Array, high: Array) -> None:
    """The discs, the ring that the robot's centre must not enter, and the distance to it as shading."""
    m = manoeuvre
    if not m.case.discs:
        return
    places = np.array(m.case.discs)
    kept = m.settings.robot_radius + m.settings.clearance
    shade_distance(ax, low, high, lambda points: m.gaps(points) - m.settings.clearance, _REACH, "#b9c2cf")
    scene.discs("discs", places, colour="fixed", legend="unforeseen disc (ground: nearer is darker)")
    rings = merge([ring(row[:2], row[2] + kept - 0.005, 0.01, 0.001, corners=64) for row in places])
    scene.mesh("rings", rings, colour="ink", swatch="ring", legend="the robot's centre stays outside")
    for place in places:
        scene.label("unforeseen disc", place[:2])


def _marks(manoeuvre: Manoeuvre, scene: Scene) -> None:
    """Start, end of the path, cusps and inflections, each with a word."""
    m = manoeuvre
    ends = {"start": m.states[0], "goal": m.case.reference(m.settings)[-1]}
    for (name, pose), colour in zip(ends.items(), ("start", "goal"), strict=True):
        scene.points(name, [*pose[:2], _ABOVE], pixels=16.0, colour=colour, legend="")
        scene.label(name, pose[:2])
    for k in m.cusps:
        ways = ("backward", "forward") if m.controls[k, 0] > 0.0 else ("forward", "backward")
        scene.label(f"cusp at {m.time[k]:.1f} s:\n{ways[0]} till here,\n{ways[1]} from here", m.states[k, :2])
    for name, nodes, colour in (("cusp: v passes through 0", m.cusps, "fixed"),
                                ("inflection: $\\omega$ changes sign", m.inflections, "ink")):  # fmt: skip
        if nodes:
            scene.points(name, [[*m.states[k, :2], _ABOVE] for k in nodes], pixels=14.0, colour=colour)


def _title(manoeuvre: Manoeuvre) -> str:
    m = manoeuvre
    ended = "optimum" if m.solution.converged else m.solution.status.name.lower().replace("_", " ")
    limits = "all limits kept" if m.within_limits else "a LIMIT BROKEN"
    return (
        f"{m.case.name}: {m.case.title}\n"
        f"{ended} after {m.solution.iterations} iterations of {m.solver}, cost {m.solution.cost:.4g}, {limits}"
    )
