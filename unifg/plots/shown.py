"""Families of variables as pictures, each kind of manifold in its own way, products component by component.

Poses are paths seen from above with headings, positions of poses in space have a panel of their height, rotations are
roll, pitch and yaw, all else is numbers over the index of the member. Covariances are ellipses and bands of two
standard deviations. Limits that a bound sets are shaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from unifg.errors import ViewError
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Manifold, Product
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import face, headline, new_figure
from unifg.typing import Array, Axes, Figure, IntArray

SIGMAS = 2.0  # standard deviations that ellipses and bands show
ARROWS = 45  # headings along one path
ELLIPSES = 16  # along one path
POINTS = 60  # members that are marked one by one
CURVES = 9  # numbers of a vector that have a colour and a name each
PANELS = 24  # in one figure
CYCLE = ("robot", "fixed", "horizon", "estimate", "moving", "trail", "goal", "odometry", "scan")
"""Names of the colours of curves."""
TURN: dict[Manifold, int] = {SO3: 0, SE3: 3, SE23: 6}
"""Where the rotation stands in storage."""
STEP = 1e-6  # of differences from tangent steps to what is drawn


Panel: TypeAlias = "Callable[[Shown, Axes], Axes]"
"""Draws a component into axes."""


@dataclass(frozen=True)
class Shown:
    """A family, or a component of one, and what is known of it.

    Attributes:
        name: as its user writes it.
        manifold: of every member.
        members: (n,) indices within the family.
        values: (n, storage).
        covariance: (n, d, d) marginals in the tangent of each member; None where nobody asked.
        lower, upper: (n, storage) limits of bounds, infinite where there are none.
        links: (k, 2) pairs of rows that a factor joins though they are no neighbours.
    """

    name: str
    manifold: Manifold
    members: IntArray
    values: Array
    lower: Array
    upper: Array
    links: IntArray
    covariance: Array | None = None

    def components(self) -> Iterator[Shown]:
        """The same taken apart, down to manifolds that are no products."""
        if not isinstance(self.manifold, Product):
            yield self
            return
        for component in self.manifold.components.values():
            at, to = component.storage, component.tangent
            covariance = None if self.covariance is None else self.covariance[:, to, to]
            limits = self.lower[:, at], self.upper[:, at]
            name, values = f"{self.name}.{component.name}", self.values[:, at]
            part = Shown(name, component.manifold, self.members, values, *limits, self.links, covariance)
            yield from part.components()


def draw_shown(parts: Sequence[Shown], title: str = "") -> Figure:
    """One figure of all parts, a panel or more for each component.

    Raises:
        ViewError: there is nothing to draw, or more than fits into a figure.
    """
    leaves = [leaf for part in parts for leaf in part.components() if len(leaf.members)]
    panels = [(leaf, draw) for leaf in leaves for draw in _panels(leaf)]
    if not panels:
        raise ViewError("there are no variables to plot")
    if len(panels) > PANELS:
        raise ViewError(f"{len(panels)} panels do not fit into one figure: name some variables, as in solution.plot(x)")
    columns = 1 if len(panels) == 1 else 2 if len(panels) <= 8 else 3
    rows = -(-len(panels) // columns)
    size = (8.0, 5.0) if columns == 1 else (5.4 * columns, 3.1 * rows + 0.4)
    with new_figure(size) as figure:
        axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for ax, (leaf, draw) in zip(axes, panels, strict=False):
            draw(leaf, ax)
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        if title:
            headline(figure, title, 11.0)
        return figure


def _panels(leaf: Shown) -> list[Panel]:
    """Panels of a component: poses from above, then everything that is numbers over the index of the member."""
    manifold, title = leaf.manifold, f"{leaf.name}: {len(leaf.members)} x {leaf.manifold.name}"
    if manifold not in (SE2, *TURN):
        count = manifold.storage
        names = ["angle"] if manifold == SO2 else [f"[{k}]" for k in range(count)] if count > 1 else [""]
        shown: Callable[[Array], Array] = partial(np.unwrap, axis=0) if manifold == SO2 else np.asarray
        return [partial(_curves, shown=shown, names=names, title=title, unit="[rad]" if manifold == SO2 else "")]
    rotation = partial(_curves, names=["roll", "pitch", "yaw"], title=f"{leaf.name}: rotation", unit="[rad]")
    angles = partial(rotation, shown=lambda x: _angles(x[:, TURN[manifold] :]))
    height = partial(_curves, shown=lambda x: x[:, 2:3], names=["z"], title=f"{leaf.name}: height", unit="z [m]")
    title, names = f"{leaf.name}: velocity", ["vx", "vy", "vz"]
    velocity = partial(_curves, shown=lambda x: x[:, 3:6], names=names, title=title, unit="[m/s]")
    panels: dict[Manifold, list[Panel]] = {
        SE2: [draw_path],
        SE3: [draw_path, height, angles],
        SE23: [draw_path, height, velocity, angles],
    }
    return panels.get(manifold, [angles])


def _angles(turns: Array) -> Array:
    """(n, 3) roll, pitch and yaw of rotations (n, 4), without jumps."""
    return np.unwrap(np.stack(SO3.to_rpy(turns), axis=1), axis=0)


# ---------------------------------------------------------------- paths


def draw_path(part: Shown, ax: Axes) -> Axes:
    """Poses from above: the path, headings, factors between poses that are no neighbours, ellipses of the positions."""
    from matplotlib.collections import LineCollection

    at, forward = part.values[:, :2], _forward(part)
    if len(part.links):
        lines = LineCollection(list(at[part.links]), colors=css("closure"), linewidths=0.6, alpha=0.6, zorder=1)
        lines.set_label(f"factors between poses apart ({len(part.links)})")
        ax.add_collection(lines)
    for first, last in _runs(part.members):
        ax.plot(at[first:last, 0], at[first:last, 1], color=css("trail"), lw=1.3, zorder=2)
    shown = every(len(at), ARROWS)
    ax.quiver(*at[shown].T, *forward[shown].T, color=css("robot"), angles="xy", pivot="middle", units="inches",
              scale_units="inches", scale=6.5, width=0.016, headwidth=5.0, headlength=5.0, zorder=3)  # fmt: skip
    if part.covariance is not None:
        _ellipses(part, carried(part.manifold, part.values, part.covariance, lambda x: x[:, :2]), ax)
    ax.plot(*at[0], "o", ms=6.0, mfc="white", mec=INK, mew=1.2, zorder=4, label=f"first [{part.members[0]}]")
    if len(at) > 1:
        ax.plot(*at[-1], "s", ms=6.0, mfc=css("goal"), mec=INK, mew=0.9, zorder=4, label=f"last [{part.members[-1]}]")
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.08)
    face(ax, f"{part.name}: {_poses(part)}", "y [m]", "x [m]")
    ax.legend(loc="best", handlelength=1.2)
    return ax


def _poses(part: Shown) -> str:
    return f"{len(part.members)} poses" + ("" if part.manifold == SE2 else " from above")


def _forward(part: Shown) -> Array:
    """(n, 2) where the x axis of each body points, seen from above; shorter where it points up."""
    if part.manifold == SE2:
        return np.stack([np.cos(part.values[:, 2]), np.sin(part.values[:, 2])], axis=1)
    return np.asarray(SO3.act(part.values[:, TURN[part.manifold] :], np.array([1.0, 0.0, 0.0])))[:, :2]


def _ellipses(part: Shown, spread: Array, ax: Axes) -> None:
    """Of covariances (n, 2, 2) of positions in the world, at some of the poses."""
    from matplotlib.collections import PolyCollection

    circle = np.stack([np.cos(angles := np.linspace(0.0, 2.0 * np.pi, 41)), np.sin(angles)], axis=1)
    shown = every(len(spread), ELLIPSES)
    values, vectors = np.linalg.eigh(spread[shown])
    roots = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    shapes = np.einsum("nij,nj,kj->nki", vectors, roots, circle) + part.values[shown, None, :2]
    label = f"{SIGMAS:g} sigma of the position"
    ax.add_collection(
        PolyCollection(list(shapes), fc=css("estimate"), ec=css("estimate"), alpha=0.2, lw=0.9, zorder=1, label=label)
    )
    ax.update_datalim(shapes.reshape(-1, 2))


# ---------------------------------------------------------------- numbers over the index


def _curves(
    part: Shown, ax: Axes, shown: Callable[[Array], Array], names: Sequence[str], title: str, unit: str
) -> Axes:
    """Curves of each member over its index, with bands and limits."""
    from matplotlib.ticker import MaxNLocator

    index, values = part.members, shown(part.values)
    many = len(names) > CURVES
    spread = None
    if part.covariance is not None:
        covariances = carried(part.manifold, part.values, part.covariance, shown)
        spread = SIGMAS * np.sqrt(np.maximum(np.einsum("nii->ni", covariances), 0.0))
    marker = "." if len(index) <= POINTS else ""
    for k, name in enumerate(names):
        colour = GREY if many else css(CYCLE[k % len(CYCLE)])
        for run, (first, last) in enumerate(_runs(index)):
            part_of = slice(first, last)
            ax.plot(index[part_of], values[part_of, k], color=colour, lw=0.6 if many else 1.3, marker=marker, ms=4.0,
                    label=None if run or many else name)  # fmt: skip
            if spread is not None:
                low, high = values[part_of, k] - spread[part_of, k], values[part_of, k] + spread[part_of, k]
                if last - first > 1:
                    ax.fill_between(index[part_of], low, high, color=colour, alpha=0.18, lw=0)
                else:
                    ax.plot(index[[first, first]], [low[0], high[0]], color=colour, lw=3.0, alpha=0.3)
    if values.shape == part.lower.shape:
        _limits(part, ax, [GREY if many else css(CYCLE[k % len(CYCLE)]) for k in range(len(names))])
    face(ax, title, unit, "member")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(names) > 1 and not many:
        ax.legend(loc="best", ncols=3, handlelength=1.2)
    if spread is not None:
        ax.annotate(f"band: {SIGMAS:g} sigma", (1.0, 1.0), xycoords="axes fraction", ha="right", va="bottom",
                    fontsize=7.5, color=GREY)  # fmt: skip
    return ax


def _limits(part: Shown, ax: Axes, colours: Sequence[str]) -> None:
    """Shade what a bound forbids to all curves; dashes in the colour of a curve where limits differ."""
    for limits, outwards in ((part.lower, -1.0), (part.upper, 1.0)):
        if not np.isfinite(limits).any():
            continue
        if (limits == limits[:, :1]).all():
            low, high = ax.get_ylim()
            edge = outwards * max(outwards * np.array([low, high, *limits[np.isfinite(limits)]])) + outwards * 0.08 * (
                high - low
            )
            level = np.where(np.isfinite(limits[:, 0]), limits[:, 0], edge)
            index = part.members.astype(np.float64)
            if len(index) == 1:
                index, level = index[0] + np.array([-0.5, 0.5]), np.repeat(level, 2)
            ax.fill_between(index, level, edge, color=css("moving"), alpha=0.13, lw=0, zorder=0)
            ax.plot(index, np.where(level == edge, np.nan, level), color=css("moving"), lw=0.9, zorder=1)
            ax.set_ylim(min(low, edge), max(high, edge))
            continue
        for k, colour in enumerate(colours):
            ax.plot(part.members, np.where(np.isfinite(limits[:, k]), limits[:, k], np.nan), color=colour, lw=0.9,
                    ls="--")  # fmt: skip


def carried(manifold: Manifold, values: Array, covariance: Array, shown: Callable[[Array], Array]) -> Array:
    """(n, k, k) covariances of what is shown of values, to first order, by central differences along the tangent.

    Args:
        manifold: of the values.
        values: (n, storage).
        covariance: (n, d, d) in the tangent spaces.
        shown: takes values, returns (n, k) numbers.
    """
    columns = []
    for step in STEP * np.eye(manifold.dim):
        ends = [shown(np.asarray(manifold.retract(values, sign * np.tile(step, (len(values), 1))))) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2.0 * STEP))
    slopes = np.stack(columns, axis=2)
    return np.asarray(np.einsum("nia,nab,njb->nij", slopes, covariance, slopes))


def apart(pairs: IntArray, members: IntArray) -> IntArray:
    """Of pairs (k, 2) of members those that are no neighbours, as rows of a selection that has both."""
    row = np.full(max(int(pairs.max(initial=0)), int(members.max(initial=0))) + 1, -1, dtype=np.intp)
    row[members] = np.arange(len(members))
    rows: IntArray = row[pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1]]
    return rows[(rows >= 0).all(axis=1)]


def _runs(members: IntArray) -> list[tuple[int, int]]:
    """First and last (exclusive) row of members that ascend by equal steps: those are joined by a line."""
    if len(members) < 2:
        return [(0, len(members))]
    steps = np.diff(members)
    ends = [0, *(np.flatnonzero((steps <= 0) | (steps != steps[0])) + 1).tolist(), len(members)]
    return [(first, last) for first, last in pairwise(ends) if last > first]


def every(count: int, most: int) -> IntArray:
    """At most that many of 0, 1, ..., evenly, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, max(most, 1)).round().astype(np.intp))
