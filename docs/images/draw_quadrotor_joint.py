"""Draw the picture of docs/results/ta.md: ``python docs/images/draw_quadrotor_joint.py`` from the checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from draw import COST, GIVEN, HARD, Point, beside, factor, frame, variable

HERE = Path(__file__).resolve().parent
PAST, NOW, FUTURE, SHARED = "#1f5fa8", "#c8251c", "#12964a", "#8a5cd0"  # as in Fig. 1 of Ta et al.
PULL = "#f0a000"
STEP = 2.4


def main() -> None:
    """Write the picture."""
    figure = graph()
    figure.savefig(HERE / "quadrotor-joint-graph.png", dpi=130, bbox_inches="tight", facecolor="white")
    plt.close(figure)


def graph() -> Any:
    """Window and horizon around one present, with the bounds that keep the one from pulling on the other."""
    figure, ax = plt.subplots(figsize=(13.0, 6.0))
    x = {k: (STEP * k, 0.0) for k in (-3, -2, -1, 0, 1, 2, 3)}
    rho, landmark = (-2.7, 2.75), (2.3, 2.75)
    shade(ax, (-3.45 * STEP, -0.17 * STEP), PAST)
    shade(ax, (0.17 * STEP, 3.35 * STEP), FUTURE)
    for k in (-1, 0):
        step(ax, x[k], x[k + 1], rho, past=k < 0)
    for left, right in ((-3, -2), (-2, -1), (1, 2), (2, 3)):
        line(ax, x[left], x[right])
    ends = [x[-3], rho, landmark]
    factor(ax, ends, beside(x[-3], 0.0, 2.0), "what has left\nthe window", COST, (-2, 20))
    for k in (-3, -1, 0):
        factor(ax, [x[k], landmark], beside(x[k], 0.5, 0.85), "sightings" if k == -1 else "", COST, (-30, 5))
        factor(ax, [x[k]], beside(x[k], -0.45, -0.75), "height, tilt" if k == -3 else "", COST, (2, -14))
    for k in (1, 3):
        factor(ax, [x[k], landmark], beside(x[k], 0.0, 1.25), "clearance" if k == 1 else "", HARD, (34, 0))
        factor(ax, [x[k]], beside(x[k], 0.5, -0.75), "way, pace, level" if k == 1 else "", COST, (12, -14))
    factor(ax, [x[0]], beside(x[0], 0.0, -0.75), "", PULL)
    factor(ax, [rho], beside(rho, 0.85, 0.0), "pull", PULL, (0, 14))
    factor(ax, [landmark], beside(landmark, 0.85, 0.0), "pull", PULL, (0, 14))
    for k, name in ((-3, "$x_{-20}$"), (-1, "$x_{-1}$"), (0, "$x_0$"), (1, "$x_1$"), (3, "$x_{30}$")):
        variable(ax, x[k], name, PAST if k < 0 else FUTURE if k > 0 else NOW)
    for k in (-2, 2):
        ax.annotate("...", x[k], ha="center", va="center", fontsize=20, bbox={"fc": "#ffffff00", "ec": "none"})
    variable(ax, rho, r"$\rho$", SHARED)
    variable(ax, landmark, "$l_j$", SHARED)
    ax.annotate("mass, drag, wind", rho, (0, 26), textcoords="offset points", ha="center", color=SHARED, fontsize=12)
    ax.annotate("map", landmark, (0, 26), textcoords="offset points", ha="center", color=SHARED, fontsize=12)
    for at, word, colour in ((-2.2, "past", PAST), (0.0, "present", NOW), (2.2, "future", FUTURE)):
        ax.annotate(word, (STEP * at, -2.75), ha="center", color=colour, fontsize=15)
    for colour, label in ((COST, "cost"), (HARD, "hard constraint"), (PULL, "bound on what the future may move")):
        ax.plot([], [], "s", ms=9, mfc=colour, mec=HARD, label=label)
    ax.plot([], [], "o", ms=12, mfc=GIVEN, mec=HARD, label="given")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, -0.1), ncol=4, frameon=False, fontsize=10)
    frame(ax, "", (-3.5 * STEP, 3.5 * STEP), (-3.0, 3.6))
    return figure


def step(ax: Any, start: Point, end: Point, rho: Point, *, past: bool) -> None:
    """Dynamics from one state to the next: under a control that was flown and noise, or under one that is chosen."""
    middle = beside(start, 0.5 * STEP, 0.0)
    below = beside(middle, 0.0, -1.2)
    ends = [start, end, rho, below]
    if not past:
        factor(ax, ends, middle, "dynamics", HARD, (26, 19))
        factor(ax, [below], beside(below, -0.5, -0.6), "limits", HARD, (-6, -14))
        factor(ax, [below], beside(below, 0.5, -0.6), "effort, change", COST, (20, -14))
        variable(ax, below, "$u_0$", FUTURE)
        return
    given = beside(middle, -0.55, -1.2)
    noise = beside(middle, 0.35, -1.2)
    factor(ax, [start, end, rho, given, noise], middle, "dynamics", HARD, (26, 19))
    factor(ax, [noise], beside(noise, 0.0, -0.75), "noise, gyro", COST, (0, -14))
    variable(ax, given, "$u_{-1}$", GIVEN, dark=True)
    variable(ax, noise, "$w_{-1}$", PAST)


def line(ax: Any, start: Point, end: Point) -> None:
    """Draw a line for a step that is like its neighbours."""
    ax.plot([start[0], end[0]], [start[1], end[1]], color="#666666", lw=1.2, zorder=1)


def shade(ax: Any, x: tuple[float, float], colour: str) -> None:
    """Ground of the past or the future."""
    ax.axvspan(*x, ymin=0.1, ymax=0.72, color=colour, alpha=0.06, lw=0)


if __name__ == "__main__":
    main()
