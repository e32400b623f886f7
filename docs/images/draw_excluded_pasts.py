"""Draw the picture of docs/results/unification.md: ``python -m docs.images.draw_excluded_pasts`` from the checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.patches import Circle

from benchmarks.excluded_pasts import CONDITIONS, PILLAR, ROBOT, explained, orchard, scanned
from unifg.style.colours import GREY, css
from unifg.style.figures import new_figure, write_figure

HERE = Path(__file__).resolve().parent
SEED, DRIVE, CONDITION = 5, 11, "half are missed, clutter"


def main() -> None:
    """Write the picture."""
    world, (chance, clutter) = orchard(SEED), CONDITIONS[CONDITION]
    scans = scanned(world, chance, clutter, 1000 * SEED + DRIVE)
    found = explained(world, scans, chance, clutter)
    with new_figure((9.2, 4.6)) as figure:
        for ax, name in zip(figure.subplots(1, 2, sharey=True), ("sightings alone", "in the graph"), strict=True):
            for pillar in world.pillars:
                ax.add_patch(Circle(pillar, PILLAR, color=GREY, lw=0))
            path = found[name]
            pose = path[scans.poses]
            cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
            ahead, aside = scans.sightings.T
            ax.plot(
                pose[:, 0] + cosine * ahead - sine * aside,
                pose[:, 1] + sine * ahead + cosine * aside,
                "+", color=css("scan"), ms=6, label="sightings, from there",
            )  # fmt: skip
            for place in path:
                ax.add_patch(Circle(place[:2], ROBOT, fill=False, color=css("estimate"), lw=0.6))
            ax.plot(world.path[:, 0], world.path[:, 1], color=css("trail"), lw=2.0, label="truth")
            ax.plot(path[:, 0], path[:, 1], color=css("estimate"), lw=1.4, label="estimate and hull")
            ax.plot(*scans.begin[:2], "o", color=css("goal"), label="believed start")
            ax.set_title(name)
            ax.set_aspect("equal")
            ax.set_xlim(-4.4, 4.4)
            ax.set_ylim(-4.4, 4.4)
        ax.legend(loc="upper right", frameon=True)
        write_figure(HERE / "excluded-pasts.png", figure, 110)


if __name__ == "__main__":
    main()
