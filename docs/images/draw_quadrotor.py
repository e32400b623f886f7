"""Draw the pictures of docs/results/ta.md: ``python docs/images/draw_quadrotor.py`` from the checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from draw import COST, HARD, beside, factor, frame, variable

from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.scenes.flight_plot import overview
from unifg.style.colours import css
from unifg.style.figures import write_figure

HERE = Path(__file__).resolve().parent
SEED = 1003
PAST, NOW, FUTURE, SHARED = "#1f5fa8", css("estimate"), "#12964a", "#8a5cd0"


def main() -> None:
    """Write both pictures."""
    figure = graph()
    figure.savefig(HERE / "quadrotor-graph.png", dpi=130, bbox_inches="tight")
    plt.close(figure)
    write_figure(HERE / "quadrotor-flight.png", overview(run_flight(FlightSettings(seed=SEED))), 130)


def graph() -> Any:
    """Past, present and future, and what they share."""
    figure, ax = plt.subplots(figsize=(13.0, 6.2))
    places = [(2.1 * k, 0.0) for k in range(-3, 4)]
    names = ["$x_{-20}$", "...", "$x_{-1}$", "$x_0$", "$x_1$", "...", "$x_{30}$"]
    rho, landmark = (-2.1, 2.6), (2.4, 2.6)
    factor(ax, [places[0], rho], beside(places[0], -0.2, 1.6), "arrival: what has\nleft the window", COST, (-52, -4))
    for k in (0, 2, 3, 5):
        middle, ahead = beside(places[k], 1.05, 0.0), k > 2
        below = beside(middle, 0.0, -1.25)
        if k in (0, 5):
            ax.plot([places[k][0], places[k + 1][0]], [0.0, 0.0], color="#666666", lw=1.2, zorder=1)
            continue
        factor(ax, [places[k], places[k + 1], below, rho], middle, "dynamics", HARD, (-29, -14))
        variable(ax, below, "$u_0$" if ahead else "$w_{-1}$", FUTURE if ahead else PAST)
        texts = ("limits", "effort, change") if ahead else ("noise", "gyro")
        kinds = (HARD, COST) if ahead else (COST, COST)
        for side, text, kind in zip((-0.55, 0.55), texts, kinds, strict=True):
            factor(ax, [below], beside(below, side, -0.55), text, kind, (8 * side, -14))
    for k in (0, 2, 3):
        factor(ax, [places[k]], beside(places[k], -0.4, -0.75), "height,\ntilt" if k == 0 else "", COST, (-24, -10))
        label = "bearing, range" if k == 2 else ""
        factor(ax, [places[k], landmark], beside(places[k], 0.55, 0.9), label, COST, (-4, 14))
    for k in (4, 6):
        factor(ax, [places[k], landmark], beside(places[k], 0.0, 1.3), "clearance" if k == 4 else "", HARD, (40, 2))
        factor(ax, [places[k]], beside(places[k], 0.55, -0.75), "way, pace, level" if k == 4 else "", COST, (8, -14))
    for place_, name in zip(places, names, strict=True):
        if name == "...":
            box = {"fc": "white", "ec": "none", "pad": 6}
            ax.annotate(name, place_, ha="center", va="center", fontsize=20, bbox=box)
        else:
            variable(ax, place_, name, PAST if place_[0] < -0.1 else NOW if place_[0] < 0.1 else FUTURE)
    variable(ax, rho, r"$\rho$", SHARED)
    variable(ax, landmark, "$l_j$", SHARED)
    ax.annotate("mass, drag, wind", beside(rho, 0.0, 0.55), ha="center", color=SHARED, fontsize=12)
    ax.annotate("landmarks", beside(landmark, 0.0, 0.55), ha="center", color=SHARED, fontsize=12)
    ax.annotate("past", (-4.6, -2.4), ha="center", color=PAST, fontsize=15)
    ax.annotate("future", (5.2, -2.4), ha="center", color=FUTURE, fontsize=15)
    ax.plot([], [], "s", ms=9, mfc=COST, mec=HARD, label="cost")
    ax.plot([], [], "s", ms=9, mfc=HARD, mec=HARD, label="hard constraint")
    ax.legend(loc="lower left", frameon=False, fontsize=9)
    frame(ax, "", (-8.2, 7.2), (-2.8, 3.5))
    return figure


if __name__ == "__main__":
    main()
