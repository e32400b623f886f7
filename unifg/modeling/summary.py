"""A statement as a table: families, terms with what they weigh and read, fixes, data.

Terms that are alike - the same kind and residual, on the same families - share a line where there are many.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TypeAlias

import numpy as np

from unifg.factors.robust import Loss
from unifg.modeling.terms import Constraint, Cost, Fix, Term
from unifg.modeling.variables import Data, Family, Selection, quantity_of

Lines: TypeAlias = list[tuple[str, ...]]
MANY = 40  # terms from which on those that are alike share a line
FEW = 4  # names that are listed


@dataclass(frozen=True)
class Group:
    """Terms that are alike.

    Attributes:
        terms: at least one, in the order of the graph.
    """

    terms: tuple[Term, ...]

    @property
    def first(self) -> Term:
        """First of the equal ones."""
        return self.terms[0]

    @property
    def name(self) -> str:
        """Of the term, or of the first and how many there are."""
        return self.first.name if len(self.terms) == 1 else f"{self.first.name}, ... ({len(self.terms)} terms)"

    @property
    def factors(self) -> int:
        """Of all of them."""
        return sum(term.count for term in self.terms)


def alike(terms: Sequence[Term], many: int = MANY) -> list[Group]:
    """Terms in groups, every one by itself where there are no more than ``many``."""
    if len(terms) <= many:
        return [Group((term,)) for term in terms]
    found: dict[tuple[object, ...], list[Term]] = {}
    for term in terms:
        on = tuple((selection.family, selection.component) for selection in term.selections)
        key = term.kind, term.residual.name, term.size, on, type(getattr(term, "robust", None))
        found.setdefault(key, []).append(term)
    return [Group(tuple(group)) for group in found.values()]


def inventory(
    families: Iterable[Family],
    terms: Sequence[Term],
    fixes: Sequence[Fix],
    data: Iterable[Data],
    routes: Mapping[str, str],
) -> str:
    """The table.

    Args:
        families: of the graph.
        terms: of the graph.
        fixes: of the graph.
        data: of the graph.
        routes: for each term by name, how it is evaluated and differentiated; of others the statement says what it can.
    """
    families, data = list(families), list(data)
    held = {family: _held(family, fixes) for family in families}
    unknowns = sum(family.count * family.manifold.dim - held[family] for family in families)
    rows = [(term, term.count * term.size) for term in terms]
    sizes = [
        f"{unknowns} unknowns",
        f"{sum(n for term, n in rows if isinstance(term, Cost))} rows of costs",
        f"{sum(n for term, n in rows if isinstance(term, Constraint))} of constraints",
    ]
    parts = [f"Graph of {counted(len(families), 'family', 'families')} and {counted(len(terms), 'term')}: "
             + ", ".join(sizes)]  # fmt: skip
    tables = [
        _aligned("<><>>><<", _families(families, held)),
        _aligned("<<>><<<<", _terms(terms, routes)),
        _aligned("<<<", [("fix", "variables", "data"), *((f.name, _selected(f.selection), _listed(f)) for f in fixes)]),
        _aligned("<<<<<<", _data(data, [*terms, *fixes])),
    ]
    parts += filter(None, tables)
    return "\n\n".join(parts)


def _families(families: Sequence[Family], held: Mapping[Family, int]) -> Lines:
    lines: Lines = [("family", "members", "manifold", "stored", "tangent", "unknown", "units", "frame")]
    for family in families:
        manifold, width = family.manifold, family.count * family.manifold.dim - held[family]
        sizes = f"{manifold.storage}", f"{manifold.dim}", f"{width}"
        lines.append((family.name, f"{family.count}", manifold.name, *sizes, *_declared(family)))
    return lines


def _terms(terms: Sequence[Term], routes: Mapping[str, str]) -> Lines:
    lines: Lines = [("term", "kind", "factors", "rows", "variables", "weight or limits", "data", "evaluated")]
    for group in alike(terms):
        term = group.first
        variables = ", ".join(map(_selected, term.selections))
        sizes = f"{group.factors}", f"{term.size}"
        lines.append((group.name, term.kind, *sizes, variables, weight(term), _listed(term), _evaluated(group, routes)))
    return lines


def _data(data: Sequence[Data], stated: Sequence[Term | Fix]) -> Lines:
    lines: Lines = [("data", "shape", "each", "units", "frame", "used by")]
    for handle in data:
        users = [one.name for one in stated if handle in one.data]
        shown = ", ".join(users[:FEW]) + (f", ... ({len(users)})" if len(users) > FEW else "")
        each = "yes" if handle.each else ""
        lines.append((handle.name, f"{handle.value.shape}", each, *_declared(handle), shown or "nothing"))
    return lines


def _declared(given: Family | Data) -> tuple[str, str]:
    """Units and frame of a family or data."""
    found = quantity_of(given)
    return ", ".join(found.units), found.frame


def _listed(stated: Term | Fix) -> str:
    """Names of what a statement reads."""
    return ", ".join(handle.name for handle in stated.data)


def weight(term: Term) -> str:
    """Weight of a cost, or the limits of a constraint, in a few characters."""
    if isinstance(term, Cost):
        words = []
        for name, value in (("sigma", term.sigma), ("information", term.information)):
            if value is not None:
                words.append(f"{name} {_numbers(value)}")
        if term.robust is not None:
            words.append(_loss(term.robust))
        return ", ".join(words)
    if isinstance(term, Constraint):
        if term.slack is not None:
            return f"{weight(replace(term, slack=None))}, soft"
        low, high = _numbers(term.lower), _numbers(term.upper)
        if term.kind == "equality" and low == high:
            return f"= {low}"
        if "-inf" == low or "inf" == high:
            return (f"<= {high}" if high != "inf" else "") if low == "-inf" else f">= {low}"
        return f"{low} .. {high}"
    return ""


def _numbers(value: object) -> str:
    """A number, a short list of numbers, a shape, or the name of data."""
    if isinstance(value, Data):
        return f"data {value.name}"
    array = np.asarray(value, dtype=np.float64)
    if array.size and (array == array.flat[0]).all() and array.ndim < 2:
        return f"{array.flat[0]:g}"
    if array.ndim == 1 and array.size <= FEW:
        return "(" + ", ".join(f"{entry:g}" for entry in array) + ")"
    return f"{array.shape}"


def _loss(loss: Loss) -> str:
    text = repr(loss) if type(loss).__repr__ is not object.__repr__ else type(loss).__name__
    return text if len(text) <= 40 else type(loss).__name__


def _selected(selection: Selection) -> str:
    """As it would be written: x, x[3], x[:-1], x[2:10], or how many."""
    part = f".{selection.component}" if selection.component else ""
    name, indices, count = f"{selection.family.name}{part}", selection.indices, selection.family.count
    if len(indices) == 1:
        return f"{name}[{indices[0]}]"
    if (np.diff(indices) != 1).any():
        return f"{len(indices)} of {name}"
    first, last = int(indices[0]), int(indices[-1]) + 1
    if (first, last) == (0, count):
        return name
    return f"{name}[{first or ''}:{'' if last == count else last}]"


def _evaluated(group: Group, routes: Mapping[str, str]) -> str:
    """Evaluation and differentiation of a term, as in ``graph.check``, without the reasons."""
    said = [routes[term.name].partition(":")[0] if term.name in routes else _stated(term) for term in group.terms]
    return "; ".join(word for word, _ in groupby(sorted(said)))


def _stated(term: Term) -> str:
    """The same by the definition alone."""
    own = term.residual
    if isinstance(term, Constraint) and term.is_bound:
        return "the variable itself"
    if own.kernel is not None:
        return "a kernel that ships"
    if own.jacobian is not None and own.derivatives in ("", "differences"):
        return "by Python, its derivatives attached"
    return "known once it is compiled"


def _held(family: Family, fixes: Iterable[Fix]) -> int:
    """Tangent coordinates of a family that are fixed."""
    return sum(len(fix.selection) * fix.selection.manifold.dim for fix in fixes if fix.selection.family is family)


def counted(count: int, one: str, several: str = "") -> str:
    """A number and what is counted."""
    return f"{count} {one if count == 1 else several or one + 's'}"


def _aligned(sides: str, lines: Lines) -> str:
    """Columns side by side under their heads, those without anything left out; nothing without a line."""
    kept = [k for k in range(len(sides)) if any(line[k] for line in lines[1:])]
    widths = [max(len(line[k]) for line in lines) for k in kept]
    made = []
    for line in lines if kept else ():
        cells = [f"{line[k]:{sides[k]}{width}}" for k, width in zip(kept, widths, strict=True)]
        made.append("  ".join(cells).rstrip())
    return "\n".join(made)
