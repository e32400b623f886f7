"""Weights and limits of a term, compared with its residual where they are stated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.factors.whitening import reciprocals, square_roots
from unifg.modeling.duplicates import doubles
from unifg.modeling.terms import Parameter
from unifg.modeling.variables import Data, ParameterLike, as_selection, is_variable, undeclared
from unifg.typing import Array


@contextmanager
def placed(name: str | None, arguments: Sequence[Any]) -> Iterator[None]:
    """Say of every refusal which families the term is about, where it does not say so itself."""
    try:
        yield
    except GraphError as error:
        families = list(dict.fromkeys(as_selection(a).family.name for a in arguments if is_variable(a)))
        said = str(error)
        if families and not any(f"'{family}'" in said for family in families):
            listed = ", ".join(f"'{family}'" for family in families)
            error.args = (f"{said} (family {listed})",)
        error.family = error.family or (families[0] if families else None)
        error.term = error.term or name
        raise


def check_weights(
    name: str, sigma: ParameterLike | None, information: ParameterLike | None, count: int, size: int
) -> tuple[Parameter | None, Parameter | None]:
    """Sigma and information as doubles, data as they are.

    Raises:
        GraphError: naming the term, when one of them has another shape, holds something else than real numbers, or is
            no standard deviation or information matrix.
    """
    if sigma is not None:
        sigma = undeclared(name, "sigma", sigma, 2)
        sigma = sigma if isinstance(sigma, Data) else np.array(doubles(f"term '{name}': sigma", sigma, term=name))
        reciprocals(name, _present(sigma), count, size)
    if information is not None:
        information = undeclared(name, "information", information, 3)
        if not isinstance(information, Data):
            information = np.array(doubles(f"term '{name}': information", information, term=name))
        square_roots(name, _present(information), count, size)
    return sigma, information


def require_loss(name: str, robust: object) -> None:
    """See that a loss is one.

    Raises:
        GraphError: naming the term, when it is not.
    """
    if isinstance(robust, type) or not hasattr(robust, "weight"):
        raise GraphError(f"term '{name}': robust= must be a loss such as fg.Huber(1.345), found {robust!r}", term=name)


def check_limits(
    name: str, lower: ParameterLike, upper: ParameterLike, count: int, size: int
) -> tuple[Parameter, Parameter]:
    """Limits as doubles, data as they are.

    Raises:
        GraphError: naming the term, when limits are NaN, fit neither each other nor the rows, cross, or allow nothing.
    """
    both: list[Parameter] = []
    for which, limit in (("lower", lower), ("upper", upper)):
        if limit is None:
            raise GraphError(f"term '{name}': {which} is None: leave it out where there is no limit", term=name)
        made = limit = undeclared(name, which, limit, 2)
        if not isinstance(limit, Data):
            made = np.array(doubles(f"term '{name}': {which}", limit, term=name))
        _check_limit(name, which, _present(made), count, size)
        both.append(made)
    least, most = (_present(limit) for limit in both)
    if (least > most).any():
        low, high = (np.broadcast_to(limit, (count, size)) for limit in (least, most))
        crossed = np.argwhere(low > high)
        factor, row = (int(i) for i in crossed[0])
        raise GraphError(
            f"term '{name}': lower exceeds upper in factor {factor}, row {row}: {low[factor, row]!s} > "
            f"{high[factor, row]!s}",
            term=name,
            index=factor,
        )
    return both[0], both[1]


def _check_limit(name: str, which: str, limit: Array, count: int, size: int) -> None:
    if np.isnan(limit).any():
        place = tuple(int(i) for i in np.argwhere(np.isnan(limit))[0]) if limit.ndim else ""
        raise GraphError(f"term '{name}': {which} is NaN{f' at {place}' if place else ''}", term=name)
    try:
        np.broadcast_to(limit, (count, size))
    except ValueError:
        each = f"; for one number of each factor give (n, 1): {which}[:, None]" if limit.shape == (count,) else ""
        raise GraphError(
            f"term '{name}': {which} has shape {limit.shape}, expected (), ({size},) or {(count, size)}{each}",
            term=name,
        ) from None
    nothing = np.inf if which == "lower" else -np.inf
    if (limit == nothing).any():
        raise GraphError(f"term '{name}': {which} is {nothing:g}, which nothing satisfies", term=name)


def _present(parameter: Parameter) -> Array:
    return parameter.value if isinstance(parameter, Data) else np.asarray(parameter)
