"""A graph as a picture: variables are circles, factors are squares.

Small graphs are drawn factor by factor, like a score: one line for each family and each term, members from left to
right, a factor above or below the variables that it joins. Large ones are drawn family by family and term by term, with
counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.lie import Manifold, Product
from unifg.modeling.summary import Group, alike, counted, weight
from unifg.modeling.terms import Cost, Fix, Term
from unifg.modeling.variables import Data, Family
from unifg.style.colours import GREY, INK, css
from unifg.style.figures import headline, new_figure
from unifg.typing import Array, Axes, BoolArray, Figure

NODES = 500  # variables and factors that are drawn one by one
ROWS = 16  # lines of terms, before those that are alike share one
LONGEST = 40  # characters of a label
CLOSE = 0.6  # least distance of two factors in a line, that of two variables being one
CELL = 4.4  # from one family to the next, where families are drawn as a whole
STEP = 0.18  # from one line of unary factors to the next, so that none hides the edges of another
COLOURS = {
    "cost": "robot",
    "robust cost": "estimate",
    "scalar cost": "trail",
    "equality": "ink",
    "inequality": "moving",
    "bound": "fixed",
}
"""Kind of a term to the name of its colour."""


def draw_graph(families: Sequence[Family], terms: Sequence[Term], fixes: Sequence[Fix]) -> Figure:
    """The factor graph; see the module's docstring.

    Raises:
        ViewError: there is no family.
    """
    if not families:
        raise ViewError("the graph has no variables: there is nothing to draw")
    nodes = sum(family.count for family in families) + sum(term.count for term in terms)
    if nodes > NODES:
        return _draw_grouped(families, terms, fixes)
    return _draw_score(families, terms, fixes)


def kind_of(term: Term) -> str:
    """Kind of a term, costs with a robust loss apart."""
    return "robust cost" if isinstance(term, Cost) and term.robust is not None else term.kind


# ---------------------------------------------------------------- factor by factor


@dataclass
class Line:
    """One line of the score.

    Attributes:
        what: a family, or terms that are alike.
        shift: of its squares to the right.
        y: height.
    """

    what: Family | Group
    shift: float = 0.0
    y: float = 0.0


def _draw_score(families: Sequence[Family], terms: Sequence[Term], fixes: Sequence[Fix]) -> Figure:
    places = _places(families, terms)
    lines = _lines(terms, sorted(families, key=lambda family: -family.count))
    for k, line in enumerate(lines):
        line.y = -float(k)
    height = {line.what: line.y for line in lines if isinstance(line.what, Family)}
    wide = max(float(place.max()) for place in places.values()) + 1.0
    size = float(np.clip(4.2 + 0.24 * wide, 7.0, 18.0)), float(np.clip(1.5 + 0.42 * len(lines), 3.0, 12.0))
    with new_figure(size) as figure:
        ax = figure.subplots()
        room = 72.0 * min((size[0] - 3.6) / max(wide, 8.0), 0.9 * (size[1] - 1.2) / max(len(lines), 1))
        diameter = float(np.clip(0.62 * room, 3.0, 13.0))
        for line in lines:
            if isinstance(line.what, Family):
                _draw_family(ax, line, places[line.what], _fixed(line.what, fixes), diameter)
            else:
                _draw_factors(ax, line, places, height, 0.75 * diameter)
        ax.set_ylim(lines[-1].y - 0.7, lines[0].y + 0.7)
        ax.margins(x=0.02)
        ax.set_axis_off()
        _key(ax, terms, fixes)
        headline(figure, _title(families, terms), 10.5)
        return figure


def _places(families: Sequence[Family], terms: Sequence[Term]) -> dict[Family, Array]:
    """Places of the members of each family from left to right: below those of larger ones that they are joined to."""
    order = sorted(families, key=lambda family: -family.count)
    places = {order[0]: np.arange(order[0].count, dtype=np.float64)}
    width = float(order[0].count - 1)
    for family in order[1:]:
        total, times = np.zeros(family.count), np.zeros(family.count)
        for term in terms:
            own = [s for s in term.selections if s.family is family]
            others = [s for s in term.selections if s.family in places]
            if not own or not others:
                continue
            joined = [np.broadcast_to(places[s.family][s.indices], (term.count,)) for s in others]
            centre = np.mean(joined, axis=0)
            for selection in own:
                members = np.broadcast_to(selection.indices, (term.count,))
                np.add.at(total, members, centre)
                np.add.at(times, members, 1.0)
        spread = np.linspace(0.0, width, family.count) if family.count > 1 else np.array([0.5 * width])
        places[family] = _apart(np.where(times > 0, total / np.maximum(times, 1.0), spread))
    return places


def _apart(wanted: Array, gap: float = 1.0) -> Array:
    """Places so far apart at least, near those that are wanted: heaps are spread about their middle."""
    order = np.argsort(wanted, kind="stable")
    heaps: list[tuple[float, int]] = []  # middle and size
    for place in wanted[order].tolist():
        middle, size = place, 1
        while heaps and middle - 0.5 * gap * (size - 1) < heaps[-1][0] + 0.5 * gap * (heaps[-1][1] + 1) - 1e-9:
            below, count = heaps.pop()
            middle, size = (middle * size + below * count) / (size + count), size + count
        heaps.append((middle, size))
    result = np.empty(len(wanted))
    result[order] = np.concatenate([m + gap * (np.arange(size) - 0.5 * (size - 1)) for m, size in heaps])
    return result


def _lines(terms: Sequence[Term], order: Sequence[Family]) -> list[Line]:
    """The largest family in the middle, others below and above, between them what joins them, about them their own.

    The second stands below; later ones stand above where nothing joins them to those below.
    """
    groups = alike(terms, ROWS)
    number = {family: k for k, family in enumerate(order)}
    above = {order[0]}
    lines: list[Line] = []
    for k, family in enumerate(order):
        own = [group for group in groups if group.first.families == [family]]
        own.sort(key=lambda group: -len(group.first.selections))  # those that join members next to them
        joint = [group for group in groups if sorted(map(number.__getitem__, group.first.families))[1:2] == [k]]
        mine = _shifted(own)
        joined = {other for group in groups if family in group.first.families for other in group.first.families}
        if k == 0:
            lines = [*mine[::-1], Line(family)]
        elif k > 1 and joint and joined - {family} <= above:
            above.add(family)
            lines = [*mine[::-1], Line(family), *map(Line, joint), *lines]
        else:
            lines += [*map(Line, joint), Line(family), *mine]
    return lines


def _shifted(groups: Sequence[Group]) -> list[Line]:
    """Lines of one family's own terms; unary ones of the same members stand beside each other."""
    unary = [group for group in groups if len(group.first.selections) == 1]
    middle = 0.5 * (len(unary) - 1)
    step = min(STEP, 0.7 / max(len(unary), 1))
    return [Line(group, step * (unary.index(group) - middle) if group in unary else 0.0) for group in groups]


def _draw_family(ax: Axes, line: Line, places: Array, fixed: BoolArray, diameter: float) -> None:
    assert isinstance(line.what, Family)
    family = line.what
    y = np.full(family.count, line.y)
    style: dict[str, Any] = {"marker": "o", "ls": "none", "ms": diameter, "mec": INK, "mew": 0.9, "zorder": 3}
    ax.plot(places[~fixed], y[~fixed], mfc="white", **style)
    ax.plot(places[fixed], y[fixed], mfc="#b8bec7", **style)
    each = max(1, int(np.ceil(family.count / 12)))
    for k in range(0, family.count, each):
        if diameter > 8.5:
            ax.annotate(f"{k}", (places[k], line.y), ha="center", va="center", fontsize=5.8, color=INK, zorder=4)
    _label(ax, line.y, family.name, f"{family.count} x {_named(family.manifold)}", INK, bold=True)


def _draw_factors(
    ax: Axes, line: Line, places: Mapping[Family, Array], height: Mapping[Family, float], side: float
) -> None:
    assert isinstance(line.what, Group)
    kind = kind_of(line.what.first)
    colour = css(COLOURS[kind])
    for x, term in zip(_squares(line.what.terms, places), line.what.terms, strict=True):
        x = x + line.shift
        for selection in term.selections:
            end = np.broadcast_to(places[selection.family][selection.indices], (term.count,))
            low, high = np.full(term.count, line.y), np.full(term.count, height[selection.family])
            _segments(ax, np.stack([np.stack([x, low], axis=1), np.stack([end, high], axis=1)], axis=1), colour, 0.8)
        on = _active(term)
        style: dict[str, Any] = {"marker": "s", "ls": "none", "ms": side, "mec": colour, "mew": 0.9, "zorder": 3}
        ax.plot(x[on], np.full(int(on.sum()), line.y), mfc=colour, **style)
        ax.plot(x[~on], np.full(int((~on).sum()), line.y), mfc="white", **style)
    said = counted(line.what.factors, "factor"), _components(line.what), weight(line.what.first)
    _label(ax, line.y, line.what.name, ", ".join(filter(None, said)), colour)


def _squares(terms: Sequence[Term], places: Mapping[Family, Array]) -> list[Array]:
    """Places of the factors of one line: amid their variables, beside each other."""
    amid = []
    for term in terms:
        ends = [np.broadcast_to(places[s.family][s.indices], (term.count,)) for s in term.selections]
        amid.append(np.mean(ends, axis=0))
    ends_at = np.cumsum([len(part) for part in amid])[:-1]
    return np.split(_apart(np.concatenate(amid), CLOSE), ends_at)


def _active(term: Term) -> BoolArray:
    mask = term.active.value if isinstance(term.active, Data) else term.active
    return np.ones(term.count, dtype=bool) if mask is None else np.asarray(np.broadcast_to(mask, (term.count,)))


def _fixed(family: Family, fixes: Iterable[Fix]) -> BoolArray:
    """Members that are fixed altogether."""
    held = np.zeros(family.count)
    for fix in fixes:
        if fix.selection.family is family:
            held[fix.selection.indices] += fix.selection.manifold.dim
    return held >= family.manifold.dim


def _segments(ax: Axes, ends: Array, colour: str, width: float) -> None:
    """Straight lines (k, 2, 2)."""
    from matplotlib.collections import LineCollection

    ax.add_collection(LineCollection(list(ends), colors=colour, linewidths=width, alpha=0.55, zorder=1))


def _label(ax: Axes, y: float, name: str, said: str, colour: str, bold: bool = False) -> None:
    """Name of a line at its left, what it holds beside it in small."""
    at = {"xycoords": ax.get_yaxis_transform(), "ha": "right", "va": "center", "annotation_clip": False}
    weight = "bold" if bold else "normal"
    ax.annotate(_short(name), (-0.012, y + 0.14), fontsize=8.5, color=colour, fontweight=weight, **at)  # type: ignore[arg-type]
    ax.annotate(_short(said), (-0.012, y - 0.24), fontsize=6.4, color=GREY, **at)  # type: ignore[arg-type]


def _named(manifold: Manifold) -> str:
    """Name of a manifold, of a product the names of its components."""
    return f"({', '.join(manifold.components)})" if isinstance(manifold, Product) else manifold.name


def _components(group: Group) -> str:
    """Components that a term reads."""
    parts = [f"{s.family.name}.{s.component}" for s in group.first.selections if s.component]
    return "on " + ", ".join(dict.fromkeys(parts)) if parts else ""


def _beside(ax: Axes, at: tuple[float, float], name: str, said: str, colour: str, points: int) -> None:
    """Name of a term at the right of its square, what it holds below in small."""
    box = {"boxstyle": "square,pad=0.05", "fc": "white", "ec": "none", "alpha": 0.8}
    for text, up, size, ink in ((name, 1 if said else -3, 8.5, colour), (_short(said), -8, 6.4, GREY)):
        ax.annotate(text, at, xytext=(points, up), textcoords="offset points", fontsize=size, color=ink, zorder=2,
                    bbox=box)  # fmt: skip


def _short(text: str, longest: int = LONGEST) -> str:
    return text if len(text) <= longest else text[: longest - 2] + ".."


# ---------------------------------------------------------------- family by family


def _draw_grouped(families: Sequence[Family], terms: Sequence[Term], fixes: Sequence[Fix]) -> Figure:
    groups = alike(terms, ROWS)
    order = sorted(families, key=lambda family: -family.count)
    spot = {family: CELL * k for k, family in enumerate(order)}
    heights: dict[Family, int] = dict.fromkeys(order, 0)
    placed: list[tuple[Group, float, float]] = []
    depth = 0
    for group in groups:
        members = group.first.families
        if len(members) == 1:
            placed.append((group, spot[members[0]] + 1.3, 0.9 * heights[members[0]]))
            heights[members[0]] += 1
        else:
            depth += 1
            placed.append((group, float(np.mean([spot[family] for family in members])), -0.5 - 0.9 * depth))
    top, bottom = 0.9 * max(1, *heights.values()) + 0.4, -1.0 - 0.9 * depth
    size = min(1.2 + 0.72 * CELL * len(order), 20.0), float(np.clip(1.2 + 0.6 * (top - bottom), 2.6, 14.0))
    with new_figure(size) as figure:
        ax = figure.subplots()
        for group, x, y in placed:
            colour = css(COLOURS[kind_of(group.first)])
            _segments(ax, np.array([[(x, y), (spot[family], 0.0)] for family in group.first.families]), colour, 1.4)
            ax.plot(x, y, "s", ms=11, mfc=colour, mec=colour, zorder=3)
            count = len(group.first.selections)
            joined = f"joins {count}" if count > 1 else ""
            said = ", ".join(filter(None, [joined, _components(group), weight(group.first)]))
            _beside(ax, (x, y), f"{_short(group.name)}  {group.factors}", said, colour, 11)
        for family, x in spot.items():
            held = int(_fixed(family, fixes).sum())
            ax.plot(x, 0.0, "o", ms=44, mfc="white", mec=INK, mew=1.2, zorder=3)
            for text, up, points in (
                (family.name, 6, 10.0 if len(family.name) < 7 else 7.5),
                (f"{family.count}", -7, 8.0),
            ):
                ax.annotate(_short(text, 10), (x, 0.0), xytext=(0, up), textcoords="offset points", fontsize=points,
                            ha="center", va="center", color=INK, zorder=4)  # fmt: skip
            said = _named(family.manifold) + (f", {held} fixed" if held else "")
            ax.annotate(_short(said), (x, 0.0), xytext=(0, 28), textcoords="offset points", fontsize=6.6, color=GREY,
                        ha="center", zorder=4)  # fmt: skip
        ax.set_xlim(-1.0, max(spot.values()) + CELL - 1.0)
        ax.set_ylim(bottom, top)
        ax.set_axis_off()
        _key(ax, terms, fixes)
        headline(figure, _title(families, terms), 10.5)
        return figure


# ---------------------------------------------------------------- what both have


def _title(families: Sequence[Family], terms: Sequence[Term]) -> str:
    members, factors = sum(family.count for family in families), sum(term.count for term in terms)
    variables = f"{counted(members, 'variable')} in {counted(len(families), 'family', 'families')}"
    return f"{variables}, {counted(factors, 'factor')} of {counted(len(terms), 'term')}"


def _key(ax: Axes, terms: Sequence[Term], fixes: Sequence[Fix]) -> None:
    """Legend of circles and squares."""
    style: dict[str, Any] = {"ls": "none", "mec": INK}
    ax.plot([], [], marker="o", mfc="white", label="variable", **style)
    if fixes:
        ax.plot([], [], marker="o", mfc="#b8bec7", label="fixed", **style)
    present = {kind_of(term) for term in terms}
    for kind in (kind for kind in COLOURS if kind in present):
        colour = css(COLOURS[kind])
        ax.plot([], [], marker="s", ls="none", mfc=colour, mec=colour, label=kind)
    if any(not _active(term).all() for term in terms):
        ax.plot([], [], marker="s", mfc="white", label="not active", **style)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=8, markerscale=0.9, handletextpad=0.2)
