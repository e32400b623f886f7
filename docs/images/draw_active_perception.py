"""Draw the picture of docs/results/unification.md: ``PYTHONPATH=. python docs/images/draw_active_perception.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from draw_covariance_plans import drawn

from benchmarks.active_perception import dark, planned
from problems import belief_plans
from unifg.style.colours import css
from unifg.style.figures import new_figure, write_figure

HERE = Path(__file__).resolve().parent
SEED = 104


def main() -> None:
    """Write the picture."""
    world = dark(SEED)
    chosen = {way: [plan for _, plan in planned(SEED, way) if plan is not None][-1] for way in WORDS}
    with new_figure((7.6, 8.6)) as figure:
        for ax, (way, plan) in zip(figure.subplots(2, 1, sharex=True), chosen.items(), strict=True):
            drawn(ax, world, plan)
            drives = belief_plans.drive(plan, world, 300, SEED)
            for path in drives.paths[:, :40].swapaxes(0, 1):
                ax.plot(path[:, 0], path[:, 1], color=css("trail"), lw=0.5, alpha=0.5, zorder=2)
            found, foreseen = 100.0 * np.sqrt(np.mean(drives.arrival**2)), 100.0 * plan.deviation[-1]
            ax.set_title(f"{WORDS[way]}: {plan.duration:.1f} s, {foreseen:.0f} cm foreseen, {found:.0f} cm found")
            ax.set_ylim(-5.0, 5.0)
        write_figure(HERE / "active-perception.png", figure, 110)


WORDS = {"in the cost": "deviation in the cost", "rule": "past a beacon"}


if __name__ == "__main__":
    main()
