"""Families of unknowns, selections from them, and data that can be replaced between solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from unifg.errors import GraphError
from unifg.lie import Manifold, Product
from unifg.modeling.duplicates import doubles
from unifg.modeling.quantities import NOTHING, Quantity, quantity
from unifg.typing import Array, ArrayLike, IntArray

Index: TypeAlias = int | slice | Sequence[int] | IntArray


class Selection:
    """Some members of a family, or one component of each.

    Attributes:
        family: the family selected from.
        indices: (n,) positions in the family, non-negative.
        count: number of them.
        component: name of the selected component of a product manifold, or None for the whole.
    """

    def __init__(self, family: Family, indices: IntArray, component: str | None = None) -> None:
        """Select ``indices`` of ``family``; use ``family[...]`` instead of calling this."""
        self.family = family
        self.indices = indices
        self.count = len(indices)
        self.component = component
        if component is None:
            self.manifold: Manifold = family.manifold
            self.storage = slice(0, family.manifold.storage)
            self.tangent = slice(0, family.manifold.dim)
        else:
            assert isinstance(family.manifold, Product)
            part = family.manifold.component(component)
            self.manifold, self.storage, self.tangent = part.manifold, part.storage, part.tangent

    def __len__(self) -> int:
        """Number of selected members."""
        return self.count

    def __getitem__(self, index: Index) -> Selection:
        """Select again within this selection; an int keeps length 1."""
        return Selection(self.family, pick(self.indices, index, self.family), self.component)

    def __getattr__(self, name: str) -> Selection:
        """Select a component of a product manifold by its name."""
        if name.startswith("_") or "component" not in self.__dict__:
            raise AttributeError(name)
        if self.component is not None or not has_component(self.family.manifold, name):
            raise AttributeError(no_component(self.family, name, self.component))
        return Selection(self.family, self.indices, name)

    def __repr__(self) -> str:
        """Family, component and number of members."""
        part = f".{self.component}" if self.component else ""
        return f"<{len(self)} of {self.family.name}{part}>"


class Family:
    """An array of unknowns on one manifold; made by :meth:`unifg.Graph.variables`.

    Attributes:
        name: unique name within its graph.
        manifold: manifold of every member.
        count: number of members.
    """

    _quantity: Quantity = NOTHING

    def __init__(self, name: str, manifold: Manifold, count: int, quantity: Quantity = NOTHING) -> None:
        """Describe ``count`` unknowns on ``manifold``."""
        self.name = name
        self.manifold = manifold
        self.count = count
        if quantity.declared:
            self._quantity = quantity

    def __len__(self) -> int:
        """Number of members."""
        return self.count

    def __getitem__(self, index: Index) -> Selection:
        """Select members as NumPy would; an int gives a selection of length 1."""
        if type(index) is int and -self.count <= index < self.count:
            return Selection(self, np.array([index % self.count]))
        return Selection(self, pick(np.arange(self.count), index, self))

    def __getattr__(self, name: str) -> Selection:
        """Select one component of every member of a product family."""
        if name.startswith("_") or "manifold" not in self.__dict__:
            raise AttributeError(name)
        if not has_component(self.manifold, name):
            raise AttributeError(no_component(self, name))
        return Selection(self, np.arange(self.count), name)

    def __repr__(self) -> str:
        """Name, length and manifold."""
        return f"<Family {self.name}: {self.count} x {self.manifold.name}>"


class Data:
    """A named array that may change between solves without rebuilding structure.

    Attributes:
        name: unique name within its graph.
        value: present default; a solve may override it.
        each: whether the first axis runs over the factors of every term that uses it; None where each term's function
            says so.
        quantity: declared units and frame.
    """

    quantity: Quantity = NOTHING

    def __init__(self, name: str, value: ArrayLike, each: bool | None, quantity: Quantity = NOTHING) -> None:
        """Hold a default value; made by :meth:`unifg.Graph.data`."""
        self.name = name
        self.each = each
        if quantity.declared:
            self.quantity = quantity
        self.value: Array = np.array(doubles(f"data '{name}'", value, flags=True))
        if each and self.value.ndim == 0:
            raise GraphError(f"data '{name}' is declared each=True but is a scalar: give it one row per factor")
        self.check(self.value)

    def check(self, value: ArrayLike) -> Array:
        """Return ``value`` as an array of the declared shape.

        Raises:
            GraphError: when shape or kind differ - numbers, or booleans, for which 0 and 1 may stand - or one is NaN.
        """
        array = doubles(f"data '{self.name}'", value, flags=self.value.dtype == bool)
        if array.dtype != self.value.dtype:
            if not np.isin(array, (0.0, 1.0)).all():
                raise GraphError(
                    f"data '{self.name}' was declared with booleans, found numbers besides 0 and 1: compare them, "
                    "as in v != 0"
                )
            array = array == 1.0
        if array.shape != self.value.shape:
            raise GraphError(
                f"data '{self.name}' has shape {array.shape}, but was declared with {self.value.shape}: "
                "the structure is compiled for that shape; declare new data or keep the shape and use active="
            )
        if array.dtype != bool and not np.isfinite(array).all() and np.isnan(array).any():
            where = np.argwhere(np.isnan(array))[0]
            raise GraphError(
                f"data '{self.name}' contains NaN at {tuple(map(int, where))}",
                index=int(where[0]) if where.size else None,
            )
        return array

    def __repr__(self) -> str:
        """Name and shape."""
        return f"<Data {self.name} {self.value.shape}{' each' if self.each else ''}>"


@dataclass(frozen=True, eq=False)
class Declared:
    """A constant of which it is declared whether it has a row for each factor; made by :func:`each`, :func:`shared`."""

    value: Array
    each: bool
    quantity: Quantity = NOTHING


def each(value: ArrayLike, *, units: str | None = None, frame: str | None = None) -> Declared:
    """Declare that the first axis of a constant argument, weight or limit runs over the factors of its term.

    ``units`` and ``frame`` are those of :meth:`unifg.Graph.data`.

    Raises:
        GraphError: it is a scalar, or not made of real numbers or booleans.
    """
    array = _constant("each", value)
    if array.ndim == 0:
        raise GraphError("fg.each needs one row per factor, found a scalar")
    return Declared(array, True, quantity("fg.each", units, frame))


def shared(value: ArrayLike, *, units: str | None = None, frame: str | None = None) -> Declared:
    """Declare that all factors of a term share a constant argument, weight or limit, however long it is.

    ``units`` and ``frame`` are those of :meth:`unifg.Graph.data`.

    Raises:
        GraphError: it is not made of real numbers or booleans.
    """
    return Declared(_constant("shared", value), False, quantity("fg.shared", units, frame))


def _constant(declared: str, value: ArrayLike) -> Array:
    if isinstance(value, Data):
        said = f"graph.data('{value.name}', ..., each={declared == 'each'})"
        raise GraphError(f"fg.{declared} takes constants; of data '{value.name}' say it where they are made: {said}")
    return doubles(f"an argument of fg.{declared}", value, flags=True)


ParameterLike: TypeAlias = ArrayLike | Data | Declared
"""A parameter of a term, as it may be stated."""


def undeclared(name: str, which: str, given: Any, axes: int) -> Any:
    """Weights or limits without their declaration; ``axes`` is how many they have with a row for each factor.

    Raises:
        GraphError: naming the term, when they are declared to have a row for each factor, or none, and have others.
    """
    if isinstance(given, Data | Declared) and given.each is not None and given.value.ndim:
        if (given.value.ndim == axes) != given.each:
            declared = "to have a row for each factor" if given.each else "to be shared by all factors"
            column = f"; for one number of each factor give (n, 1): {which}[:, None]" if given.value.ndim == 1 else ""
            raise GraphError(
                f"term '{name}': {which} is declared {declared}, found shape {given.value.shape}{column}", term=name
            )
    return given.value if isinstance(given, Declared) else given


Variable: TypeAlias = Family | Selection
RESERVED = frozenset({"name", "manifold", "count", "family", "indices", "component", "storage", "tangent"})
"""What families and selections have by themselves: a component of such a name could not be selected."""


def as_selection(variable: Variable) -> Selection:
    """View a whole family as a selection of all its members.

    Raises:
        GraphError: it is neither.
    """
    if not isinstance(variable, Family | Selection):
        raise GraphError(f"expected a family of variables, or some of its members, found {variable!r}")
    return variable if isinstance(variable, Selection) else variable[:]


def quantity_of(argument: Any) -> Quantity:
    """Units and frame that an argument of a term declares."""
    if isinstance(argument, Selection):
        whole = argument.family._quantity
        return whole if argument.component is None else whole.component(argument.manifold, argument.tangent)
    if isinstance(argument, Family):
        return argument._quantity
    return argument.quantity if isinstance(argument, Data | Declared) else NOTHING


def is_variable(argument: Any) -> bool:
    """Test whether a term's argument is an unknown rather than a constant."""
    return isinstance(argument, Family | Selection)


def pick(indices: IntArray, index: Index, family: Family) -> IntArray:
    """Apply a NumPy index to ``indices``, always returning one axis.

    Raises:
        GraphError: it is none, reaches beyond the members, or asks for numbers inside of them.
    """
    try:
        chosen = np.atleast_1d(np.asarray(indices[index], dtype=np.intp))
    except (IndexError, TypeError, ValueError) as error:
        raise GraphError(_no_member(indices, index, family, error), family=family.name) from error
    if chosen.ndim > 1:
        raise GraphError(
            f"family '{family.name}': a selection has one axis, and {index!r} makes {chosen.ndim}: give integers, a "
            "slice or a mask",
            family=family.name,
        )
    return chosen


def _no_member(indices: IntArray, index: Any, family: Family, error: Exception) -> str:
    """Message about an index that selects no members."""
    if isinstance(index, tuple):
        return (
            f"family '{family.name}' is indexed by its members alone, found {index!r}: {_components(family)}; single "
            "numbers of a member are taken in the residual, as in lambda p: p[:, :2]"
        )
    if isinstance(index, str):
        return f"family '{family.name}' is indexed by its members, found {index!r}: {_components(family)}"
    return f"family '{family.name}' has {len(indices)} members here: {error}"


def has_component(manifold: Manifold, name: str) -> bool:
    """Test whether ``manifold`` is a product with a component of that name."""
    return isinstance(manifold, Product) and name in manifold.components


def no_component(family: Family, name: str, within: str | None = None) -> str:
    """Explain which components exist, and how they are selected."""
    if within is not None:
        return (
            f"'{family.name}.{within}' has no attribute '{name}': it is a component already, and components of "
            "components are not selected; take their numbers in the residual"
        )
    return f"family '{family.name}' has no component '{name}': {_components(family)}"


def _components(family: Family) -> str:
    """Components of the members of a family, spelled as they are selected."""
    if not isinstance(family.manifold, Product):
        return f"its members are elements of {family.manifold.name}, which is no product and has no components"
    names = list(family.manifold.components)
    spelled = ", ".join(f"{family.name}.{name}" for name in names)
    return f"its components are {spelled} (of one member, {family.name}[0].{names[0]})"
