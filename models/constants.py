"""Physical constants of models, looked at once when a model is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from unifg.errors import GraphError, ModelError
from unifg.modeling.duplicates import doubles


def require_constants(model: Any, positive: Sequence[str], from_zero: Sequence[str] = ()) -> None:
    """Refuse physical constants that are not finite, not as many as by default, or without the sign they have to have.

    Args:
        model: a dataclass of numbers and tuples of numbers with defaults.
        positive: fields.
        from_zero: likewise, that may also be zero.

    Raises:
        ModelError: naming the field.
    """
    for constant in fields(model):
        name, given, default = constant.name, getattr(model, constant.name), np.array(constant.default)
        try:
            values = doubles(name, given)
        except GraphError:
            values = np.full(default.shape, np.nan)
        low = 0.0 if name in positive or name in from_zero else -np.inf
        right = values.shape == default.shape and (values >= low).all() and (values < np.inf).all()
        if not right or (name in positive and not values.all()) or (values == -np.inf).any():
            count = f"{default.size} finite numbers" if default.ndim else "a finite number"
            which = " above 0" if name in positive else " from 0 on" if name in from_zero else ""
            raise ModelError(f"{type(model).__name__}: {name} must be {count}{which}, found {given!r}")
