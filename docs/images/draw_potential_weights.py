"""Draw the picture of docs/potential-weights.md: ``python -m docs.images.draw_potential_weights``, once measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.comparison import where
from benchmarks.potential_weights import HARD, WEIGHTS
from benchmarks.report import OUT
from unifg.scenarios.campaigns.journal import lines_of
from unifg.style.colours import css
from unifg.style.figures import new_figure, write_figure

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Write the picture."""
    rows = list({tuple(row["key"]): row for row in lines_of(OUT / "potential_weights.jsonl")}.values())
    with new_figure((7.0, 3.6)) as figure:
        ax = figure.subplots()
        for k, weight in enumerate(WEIGHTS):
            some = where(rows, weight=weight)
            clearance = np.array([100.0 * row["clearance"] for row in some])
            arrived = np.array([row["reached"] for row in some])
            spread = k + np.linspace(-0.2, 0.2, len(some))
            for which, colour, words in ((arrived, "robot", "arrived"), (~arrived, "moving", "hangs")):
                ax.plot(spread[which], clearance[which], "o", ms=4, color=css(colour), label="" if k else words)
            ax.plot([k - 0.3, k + 0.3], [clearance.mean()] * 2, color=css("ink"), lw=1.5)
        ax.set_xticks(range(len(WEIGHTS)), ["constraint" if w == HARD else f"{w:g}" for w in WEIGHTS])
        ax.set_xlabel("weight of 1/d [m]")
        ax.set_ylabel("least clearance of a flight [cm]")
        ax.grid(axis="y")
        ax.legend(loc="upper left")
        write_figure(HERE / "potential-weights.png", figure, 110)


if __name__ == "__main__":
    main()
