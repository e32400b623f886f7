"""Draw the picture of docs/results/unification.md: ``python -m docs.images.draw_covariance_plans``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Circle, Ellipse

from benchmarks.covariance_plans import RESERVE
from problems import belief_plans
from problems.belief_plans import SENSOR, Layout, Plan, Planner, sweep
from unifg.models import uncertainty
from unifg.style.colours import GREY, css
from unifg.style.figures import new_figure, write_figure

HERE = Path(__file__).resolve().parent
SEED, MARGIN, SIGMAS = 2, 0.4, 3.0


def main() -> None:
    """Write the picture."""
    world = belief_plans.layout(SEED)
    wide, sure = Planner(world, foresees=False), Planner(world)
    plans = {
        f"margin {MARGIN:g} m": sweep(wide, wide.solve, [MARGIN])[0],
        f"{SIGMAS:g} standard deviations, in the graph": sweep(
            sure, lambda guess, k: sure.solve(guess, RESERVE, k=k), [2.0, SIGMAS]
        )[-1],
    }
    with new_figure((7.6, 8.6)) as figure:
        for ax, (title, plan) in zip(figure.subplots(2, 1, sharex=True), plans.items(), strict=True):
            assert plan is not None
            drawn(ax, world, plan)
            drives = belief_plans.drive(plan, world, 400, SEED)
            for path in drives.paths[:, :40].swapaxes(0, 1):
                ax.plot(path[:, 0], path[:, 1], color=css("trail"), lw=0.5, alpha=0.5, zorder=2)
            share = f"{100.0 * drives.collisions:.0f} % of 400 drives touch something"
            ax.set_title(f"{title}: {plan.duration:.1f} s, {share}")
        write_figure(HERE / "covariance-plans.png", figure, 130)


def drawn(ax: Any, world: Layout, plan: Plan) -> None:
    """Discs, beacons with their reach, the plan and two standard deviations about it."""
    for beacon in world.beacons:
        ax.add_patch(Circle(beacon, SENSOR.reach, color=css("goal"), alpha=0.15, lw=0))
        ax.plot(*beacon, "*", color=css("fixed"), ms=11, zorder=6)
    for centre, radius in zip(world.discs, world.radii, strict=True):
        ax.add_patch(Circle(centre, radius, color=GREY, lw=0, zorder=3))
    ax.plot(plan.poses[:, 0], plan.poses[:, 1], color=css("horizon"), lw=1.6, zorder=5)
    total = uncertainty.unpacked(plan.beliefs[:, :6] + plan.beliefs[:, 6:])[:, :2, :2]
    for pose, P in list(zip(plan.poses, total, strict=True))[::2]:
        values, vectors = np.linalg.eigh(P)
        angle = np.degrees(pose[2] + np.arctan2(vectors[1, 1], vectors[0, 1]))
        size = 4.0 * np.sqrt(values[::-1]) + 2.0 * belief_plans.ROBOT
        ax.add_patch(Ellipse(pose[:2], *size, angle=angle, fill=False, color=css("estimate"), lw=0.8, zorder=4))
    ax.set_aspect("equal")
    ax.set_xlim(-0.6, belief_plans.LENGTH + 0.6)
    ax.set_ylim(-3.9, 3.9)
    ax.set_ylabel("[m]")


if __name__ == "__main__":
    main()
