"""A manoeuvre as one picture: every iterate on the plane, the controls against their limits, the way to convergence.

Colours follow Bazzana et al. 2022, Fig. 7: the guess is green, iterates are pink and whiten as they proceed, the
optimum is blue. Nothing is told by colour alone: the guess is dashed, the optimum thick, and marks carry labels.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.scenarios.manoeuvres import Manoeuvre
from unifg.scenarios.show.style import css
from unifg.typing import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["picture", "plot_control", "plot_convergence", "plot_iterates", "write_picture"]

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # ships with matplotlib: the same picture everywhere
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e6ea",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}
_INK, _LIMIT = "#1d2430", "#6b7280"
_FIRST, _LAST = css("horizon"), css("robot")
_PINK, _WHITENED = np.array([0.84, 0.0, 0.42]), np.array([1.0, 0.86, 0.93])
_CUSP = css("fixed")
_REACH = 0.8  # [m]; how far from a disc the shading goes
_EVERY = 5  # nodes between two drawn robots
_STRAY = 0.6  # [m]; how far around the first and the last iterate the others are shown
_FLOOR = 1e-10  # smaller violations are drawn here


def write_picture(path: Path, manoeuvre: Manoeuvre, *, dpi: int = 105) -> Path:
    """Write the picture of a manoeuvre as a PNG and return its path."""
    # No software version and no date in the file: the same manoeuvre gives the same picture.
    picture(manoeuvre).savefig(path, dpi=dpi, format="png", metadata={"Software": None})
    return path


def picture(manoeuvre: Manoeuvre) -> Figure:
    """Iterates above; speed, turning speed and convergence below."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    m = manoeuvre
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.0, 8.0), layout="constrained")
        FigureCanvasAgg(figure)
        above, key, below = figure.subfigures(3, 1, height_ratios=(1.75, 0.28, 1.0), squeeze=False)[:, 0]
        place = plot_iterates(m, above.subplots())
        key.legend(*place.get_legend_handles_labels(), loc="center", ncols=3)
        speed, turning, convergence = below.subplots(1, 3)
        plot_control(m, 0, speed)
        plot_control(m, 1, turning)
        plot_convergence(m, convergence)
        figure.suptitle(_title(m), x=0.01, ha="left", fontsize=12.0, fontweight="bold")
    return figure


def plot_iterates(manoeuvre: Manoeuvre, ax: Axes) -> Axes:
    """Every iterate from the guess to the optimum, the robot along the optimum, and what stands in the way."""
    from matplotlib.patches import Circle, Polygon

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
        ax.add_patch(Circle((x, y), radius, fc=_LAST, ec=_LAST, alpha=0.13, lw=0, zorder=4))
        ax.add_patch(Circle((x, y), radius, fill=False, ec=_LAST, alpha=0.5, lw=0.7, zorder=4))
        nose = radius * np.array([[0.95, 0.0], [0.4, 0.24], [0.4, -0.24]])
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        ax.add_patch(Polygon(nose @ turn.T + [x, y], fc="white", ec=_INK, lw=1.0, zorder=7))
    name = f"front of the robot, every {_EVERY * m.settings.dt:g} s"
    ax.plot([], [], ">", color="white", mec=_INK, ms=8, label=name)
    _marks(m, ax)

    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax


def plot_control(manoeuvre: Manoeuvre, column: int, ax: Axes) -> Axes:
    """One control of the optimum over time against its limits; column 0 is v, column 1 is omega."""
    m = manoeuvre
    limit = m.settings.limits[column]
    ax.axhspan(limit, 1.3 * limit, color=_LIMIT, alpha=0.22, lw=0)
    ax.axhspan(-1.3 * limit, -limit, color=_LIMIT, alpha=0.22, lw=0)
    ax.axhline(0.0, color=_LIMIT, lw=0.8)
    held = np.append(m.controls[:, column], m.controls[-1, column])
    ax.step(m.time, held, where="post", color=_LAST, lw=1.8)
    for k in m.cusps:
        ax.axvline(m.time[k], color=_CUSP, lw=1.8, ls="--")
        ax.annotate(
            f"cusp, {m.time[k]:.1f} s", (m.time[k], -limit), xytext=(5, 5), textcoords="offset points",
            fontsize=8.5, fontweight="bold",
        )  # fmt: skip
    for k in m.inflections:
        ax.axvline(m.time[k], color=_INK, lw=1.0, ls=":")
    ax.set_ylim(-1.3 * limit, 1.3 * limit)
    ax.set_xlim(0.0, m.time[-1])
    ax.set_xlabel("time [s]")
    ax.set_ylabel(("v [m/s]", "$\\omega$ [rad/s]")[column])
    ax.set_title(("Forward speed v", "Turning speed $\\omega$")[column])
    for place in (1.15 * limit, -1.15 * limit):
        ax.text(0.98 * m.time[-1], place, "not allowed", ha="right", va="center", fontsize=8, color="#4b5563")
    ax.set_axisbelow(True)
    ax.grid(True)
    return ax


def plot_convergence(manoeuvre: Manoeuvre, ax: Axes) -> Axes:
    """Largest violation of every iterate, in the colours of the iterates, and how far from stationary it is."""
    history = manoeuvre.solution.history
    number = [row.number for row in history]
    violation = np.maximum([row.violation for row in history], _FLOOR)
    # A guess that is the reference itself costs nothing: without multipliers it is stationary by accident.
    stationarity = [row.stationarity if row.stationarity > _FLOOR else np.nan for row in history]
    ax.plot(number, stationarity, color=_LIMIT, lw=1.0, ls=":", label="stationarity")
    ax.plot(number, violation, color=_INK, lw=0.8, zorder=2, label="largest violation")
    ax.scatter(number, violation, c=shades(len(history)), s=34, ec=_INK, lw=0.6, zorder=3)
    ax.axhline(manoeuvre.settings.tolerance, color=_INK, lw=0.8, ls="--")
    ax.annotate("tolerance", (0, manoeuvre.settings.tolerance), xytext=(0, 2), textcoords="offset points", fontsize=8)
    ax.set_yscale("log")
    ax.set_ylim(bottom=0.3 * _FLOOR)
    ax.set_xlabel("iterate")
    ax.set_title("What is wrong with each iterate")
    ax.legend(loc="upper right")
    ax.set_axisbelow(True)
    ax.grid(True)
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
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Circle

    m = manoeuvre
    if not m.case.discs:
        return
    discs = np.array(m.case.discs)
    kept = m.settings.robot_radius + m.settings.clearance
    x, y = np.linspace(low[0], high[0], 240), np.linspace(low[1], high[1], 120)
    offset = np.stack(np.meshgrid(x, y), axis=2)[:, :, None, :] - discs[:, :2]
    distance = (np.linalg.norm(offset, axis=3) - discs[:, 2]).min(axis=2) - kept
    shading = LinearSegmentedColormap.from_list("near", ["#b9c2cf", "#ffffff"])
    ax.contourf(x, y, np.clip(distance, 0.0, _REACH), levels=np.linspace(0.0, _REACH, 9), cmap=shading, zorder=0)
    for index, (cx, cy, radius) in enumerate(discs.tolist()):
        first = index == 0
        disc = Circle((cx, cy), radius, fc=css("fixed"), ec="none", zorder=1)
        ring = Circle((cx, cy), radius + kept, fill=False, ec=_INK, lw=1.1, ls=(0, (2, 2)), zorder=2)
        disc.set_label("unforeseen disc (ground: nearer is darker)" if first else None)
        ring.set_label("the robot's centre stays outside" if first else None)
        ax.text(cx, cy - 0.5 * radius, "unforeseen\ndisc", ha="center", va="center", fontweight="bold", zorder=6)
        ax.add_patch(disc)
        ax.add_patch(ring)


def _marks(manoeuvre: Manoeuvre, ax: Axes) -> None:
    """Start, end of the path, cusps and inflections, each with a word."""
    m = manoeuvre
    start, goal = m.states[0], m.case.reference(m.settings)[-1]
    ax.plot(*start[:2], "o", color=css("start"), ms=8, mec="white", mew=0.8, zorder=9)
    ax.plot(*goal[:2], "*", color=css("goal"), ms=17, mec=_INK, mew=0.8, zorder=9)
    _word(ax, start, "start", (0, 30))
    _word(ax, goal, "goal", (0, 30))
    for k in m.cusps:
        name = "cusp: v passes through 0" if k == m.cusps[0] else None
        ax.plot(*m.states[k, :2], "D", color=_CUSP, ms=9, mec=_INK, mew=1.0, zorder=10, label=name)
        forward = m.controls[k, 0] > 0.0
        ways = ("backward", "forward") if forward else ("forward", "backward")
        _word(ax, m.states[k], f"cusp at {m.time[k]:.1f} s:\n{ways[0]} till here,\n{ways[1]} from here", (105, -14))
    for k in m.inflections:
        name = "inflection: $\\omega$ changes sign" if k == m.inflections[0] else None
        ax.plot(*m.states[k, :2], "s", color=_INK, ms=6, mec="white", mew=1.0, zorder=8, label=name)


def _word(ax: Axes, at: Array, text: str, offset: tuple[int, int]) -> None:
    ax.annotate(
        text, (float(at[0]), float(at[1])), xytext=offset, textcoords="offset points", ha="center", va="center",
        fontsize=9, fontweight="bold", zorder=11,
        bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85},
    )  # fmt: skip


def _title(manoeuvre: Manoeuvre) -> str:
    m = manoeuvre
    ended = "optimum" if m.solution.converged else m.solution.status.name.lower().replace("_", " ")
    limits = "all limits kept" if m.within_limits else "a LIMIT BROKEN"
    return (
        f"{m.case.name}: {m.case.title}\n"
        f"{ended} after {m.solution.iterations} iterations of {m.solver}, cost {m.solution.cost:.4g}, {limits}"
    )
