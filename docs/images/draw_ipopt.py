"""Draw the picture of docs/results/bazzana.md: ``python -m docs.images.draw_ipopt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.against_ipopt import Casadi
from unifg.scenarios.papers.control_instances import DT, LIMIT, PAPER, RHO, STEPS, STOP, Instance, Ours, bearings
from unifg.solvers import AugmentedLagrangian
from unifg.style.colours import css
from unifg.style.figures import new_figure, write_figure

HERE = Path(__file__).resolve().parent
ROW = 5  # the last one of the table, as in the paper's Fig. 8


def main() -> None:
    """Write the picture."""
    instance = Instance(bearings()[ROW])
    loop = AugmentedLagrangian(
        schedule="bazzana-damped", penalty=RHO, step_tolerance=STOP, tolerance=1e-18, keep_values=True
    )
    ours, ipopt = Ours(loop), Casadi(tol=STOP)
    for who in (ours, ipopt):
        who.state(instance)
        who()
    ways = [row.values[ours.x] for row in ours.solution.history if row.values is not None]
    times = DT * np.arange(STEPS)
    states, controls = ours.solution[ours.x], ours.solution[ours.u]
    theirs = np.asarray(ipopt.answer["x"]).reshape(STEPS, 5)[:, :2]
    with new_figure((9.0, 3.6)) as figure:
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.3])
        for k, way in enumerate(ways):
            shade = k / max(len(ways) - 1, 1)
            colour = css("fixed") if k == 0 else css("robot")
            left.plot(way[:, 0], way[:, 1], color=colour, alpha=1.0 if k == 0 else 0.15 + 0.5 * shade, lw=1.0)
        left.plot(states[:, 0], states[:, 1], color=css("robot"), lw=2.0)
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        for x, y, radius in instance.discs:
            left.fill(x + radius * np.cos(angle), y + radius * np.sin(angle), color=css("wall"), lw=0.0)
        left.set_aspect("equal")
        left.set_xlabel("x [m]")
        left.set_ylabel("y [m]")
        left.set_title("from the guess to the optimum")
        for column, name, style in ((0, "v [m/s]", "-"), (1, "omega [rad/s]", "--")):
            right.step(
                times, controls[:, column], style, where="post", color=css("robot"), label=f"{name}, damped loop"
            )
            right.plot(
                times, theirs[:, column], "o" if column == 0 else "s", ms=3, mfc="none", color=css("moving"),
                label=f"{name}, IPOPT",
            )  # fmt: skip
        for bound in (-LIMIT, LIMIT):
            right.axhline(bound, color=css("ink"), lw=0.6)
        right.set_xlabel("time [s]")
        right.set_title(f"controls, initial cost {PAPER[ROW][0]:.0f}")
        right.legend(loc="lower right")
        right.grid()
        write_figure(HERE / "ipopt.png", figure, 110)


if __name__ == "__main__":
    main()
