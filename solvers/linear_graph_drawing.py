"""Pictures of linear graphs in the manner of Ta et al. 2014, Fig. 2; matplotlib does the drawing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from unifg.solvers.linear_factors import Factor
from unifg.typing import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ASIDE = 0.32  # from a variable to the factors that stand on it alone
SHORT, ABOVE = 7, 0.24  # names from this length on stand above their circles
TURN = 2.4  # [rad] between factors that would cover each other: the golden angle spreads any number


def draw(variables: Iterable[str], factors: Iterable[Factor], ax: Axes) -> None:
    """Draw circles for variables, crosses for constraints, squares for other factors.

    Families run from left to right, one below the other. Curvature factors hang on dashed lines, as in the paper;
    damping is left out.

    Args:
        variables: names, as "family[member]".
        factors: what joins them.
        ax: a matplotlib axes; its limits and frame are changed.
    """
    at = _places(variables)
    taken: dict[tuple[float, float], int] = {}
    for factor in factors:
        if factor.kind == "damping" or not factor.variables:
            continue
        x, y = _place(factor, at, taken)
        dashed = factor.kind == "curvature"
        for name in factor.variables:
            ax.plot(
                [at[name][0], x],
                [at[name][1], y],
                color="0.6",
                linewidth=0.8,
                zorder=1,
                linestyle="--" if dashed else "-",
            )
        if factor.kind == "constraint":
            ax.scatter([x], [y], marker="x", s=24, c="tab:red", zorder=2, linewidths=1.2)
        else:
            colour = "white" if dashed else "black"
            ax.scatter([x], [y], marker="s", s=24, c=colour, edgecolors="black", zorder=2, linewidths=1.2)
    for name, (x, y) in at.items():
        ax.scatter([x], [y], s=420, c="white", edgecolors="tab:blue", zorder=3)
        above = 0.0 if len(name) < SHORT else ABOVE
        ax.text(x, y + above, name, ha="center", va="center", fontsize=6, zorder=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.1)
    ax.set_axis_off()


def _places(variables: Iterable[str]) -> dict[str, Array]:
    """(2,) where each variable stands: its member number to the right, its family downwards."""
    families: dict[str, int] = {}
    places: dict[str, Array] = {}
    for name in variables:
        family, _, member = name[:-1].rpartition("[")
        lane = families.setdefault(family, len(families))
        places[name] = np.array([float(member) + 0.5 * (lane % 2), -1.2 * lane])
    return places


def _place(factor: Factor, at: dict[str, Array], taken: dict[tuple[float, float], int]) -> tuple[float, float]:
    """Between the variables of a factor, aside of what stands there already."""
    centre = np.mean([at[name] for name in factor.variables], axis=0)
    key = (round(float(centre[0]), 6), round(float(centre[1]), 6))
    before = taken.get(key, 0)
    taken[key] = before + 1
    if len(factor.variables) == 1 or before:
        angle = -0.5 * np.pi + TURN * before
        centre = centre + ASIDE * np.array([np.cos(angle), np.sin(angle)])
    return float(centre[0]), float(centre[1])
