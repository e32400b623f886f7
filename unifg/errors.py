"""Exceptions: what was found, where it was found, and what to do about it.

Everything unifg itself raises is a :class:`UnifgError`, and so a ``ValueError``. Python's own exceptions are left to
what Python itself asks for: ``AttributeError`` from ``__getattr__`` (``hasattr`` and pickling live on it),
``ImportError`` where an optional package is missing, ``NotImplementedError`` in methods a subclass gives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf
from numbers import Integral, Real
from typing import Any


class UnifgError(ValueError):
    """Base of every error raised by unifg.

    Attributes:
        term: name of the term concerned, if any.
        family: name of the variable family concerned, if any.
        index: position within the family, the term or the argument concerned, if any.
    """

    def __init__(
        self,
        message: str,
        *,
        term: str | None = None,
        family: str | None = None,
        index: int | None = None,
    ) -> None:
        """Store the message and the place it speaks about."""
        super().__init__(message)
        self.term = term
        self.family = family
        self.index = index


def require_kinds(
    who: str, error: type[UnifgError], annotations: Mapping[str, Any], options: Mapping[str, Any], *classes: type
) -> None:
    """Refuse options that are not of the kind that their annotations name: numbers, functions, objects of ``classes``.

    Args:
        who: whose options they are.
        error: what is raised.
        annotations: text for each option; one that names several kinds is not looked at.
        options: by name.
        *classes: that annotations name, besides ``float``, ``int`` and ``Callable``.
    """
    known: dict[str, tuple[Any, str]] = {"float": (Real, "a number"), "int": (Integral, "a whole number")}
    known["Callable"] = Callable, "a function"
    known |= {kind.__name__: (kind, f"of the class {kind.__name__}") for kind in classes}
    for name, value in options.items():
        kind, _, rest = str(annotations.get(name, "")).partition(" | ")
        kind = kind.partition("[")[0]
        if kind not in known or rest not in ("", "None") or (rest and value is None):
            continue
        wanted, words = known[kind]
        found = value.item() if isinstance(getattr(value, "shape", None), tuple) and not value.shape else value
        if isinstance(found, bool) or not isinstance(found, wanted):
            how = f", a class: give an object of it, as {found.__name__}(...)" if isinstance(found, type) else ""
            raise error(f"{who}: {name} must be {words}{' or None' if rest else ''}, found {f'{value!r}'[:80]}{how}")


def require_positive(who: str, error: type[UnifgError], *, finite: bool = True, **numbers: Any) -> None:
    """Refuse what is no number, not above zero, or infinite if it must be ``finite``; else as :func:`require_kinds`."""
    require_kinds(who, error, dict.fromkeys(numbers, "float"), numbers)
    for name, value in numbers.items():
        if not 0.0 < value or (finite and value == inf):
            raise error(f"{who}: {name} must be positive{' and finite' if value == inf else ''}, found {value}")


def name_term(error: Exception, term: str) -> None:
    """Say in which term a function raised: in the message of an error of ours, in a note to any other."""
    if not isinstance(error, UnifgError):
        error.add_note(f"raised by the function of term '{term}'")
    elif error.term is None:
        error.term, error.args = term, (f"term '{term}': {error}",)


def place_error(error: Exception, family: str, member: int, factor: int) -> None:
    """Say for which factor a function raised: in the attributes of an error of ours, in a note to any other."""
    error.add_note(f"at factor {factor}, whose first variable is {family}[{member}]")
    if isinstance(error, UnifgError):
        error.family, error.index = error.family or family, factor


class GraphError(UnifgError):
    """The graph, its guess or its data cannot be solved as given."""


class NotFiniteError(GraphError):
    """A term, or a Jacobian, is not finite where a solve begins."""


class ModelError(UnifgError):
    """A model, a map or a method was given numbers or functions it cannot be made of, or cannot be evaluated with."""


class BackendError(UnifgError):
    """The chosen backend cannot take this class of problem, or is not installed."""


class ScenarioError(UnifgError):
    """A scenario was asked for something its world cannot offer."""


class ViewError(UnifgError):
    """Something cannot be drawn or shown as it was given."""


class FileFormatError(UnifgError):
    """A file does not say what its format promises."""
