"""Boolean masks of truth values that are not known yet: entries taken and put where a mask holds."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

from unifg.factors.autodiff.symbols import (
    Symbol,
    Symbols,
    TraceError,
    as_number,
    as_truth,
    choose,
    is_mask,
    plain,
    wrapped,
)

UNKNOWN = "their number is not known yet: write np.where(condition, a, b), or assign where the same mask holds"


class Masked(np.lib.mixins.NDArrayOperatorsMixin):
    """Entries of an array where a mask holds that is not known yet: all of them, each with its truth value.

    How many there are is not known. They may be computed with, and put where the same mask holds.

    Attributes:
        mask: truth values.
        entries: for each of them an entry, or an array of entries along further axes.
    """

    __slots__ = ("entries", "mask")

    def __init__(self, mask: Any, entries: Any) -> None:
        """Keep both."""
        self.mask, self.entries = mask, entries

    def of(self, mask: Any) -> Any:
        """The entries, for a mask that is the same."""
        if self.mask.shape != mask.shape or any(
            (a.node if isinstance(a, Symbol) else a) != (b.node if isinstance(b, Symbol) else b)
            for a, b in zip(plain(self.mask).flat, plain(mask).flat, strict=True)
        ):
            raise TraceError("brings entries together that two masks chose; write np.where(condition, a, b)")
        return self.entries

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        """Do what the ufunc does, entry by entry."""
        out = options.pop("out", (None,))[0]
        if method != "__call__" or not (out is None or isinstance(out, Masked)):
            raise TraceError(f"calls np.{ufunc.__name__}.{method} on the entries of a mask; {UNKNOWN}")
        given = []
        for item in inputs:
            part = item.of(self.mask) if isinstance(item, Masked) else item
            if not isinstance(item, Masked) and np.ndim(part) > self.entries.ndim - self.mask.ndim:
                raise TraceError(f"computes with the entries of a mask and another array; {UNKNOWN}")
            given.append(part)
        found = wrapped(ufunc(*given, **options))
        if out is None:
            return Masked(self.mask, found)
        out.entries = found
        return out

    def __array_function__(self, function: Any, kinds: Any, arguments: Any, options: Any) -> NoReturn:
        """Refuse: how many they are is not known."""
        raise TraceError(f"calls np.{function.__name__} on the entries of a mask; {UNKNOWN}")

    def __getattr__(self, name: str) -> NoReturn:
        """Refuse: how many they are is not known."""
        raise TraceError(f"asks the entries of a mask for {name}; {UNKNOWN}")

    def __getitem__(self, key: Any) -> NoReturn:
        """Refuse: where they stand is not known."""
        raise TraceError(f"takes some of the entries of a mask; {UNKNOWN}")

    def __len__(self) -> NoReturn:
        """Refuse: how many they are is not known."""
        raise TraceError(f"asks how many entries a mask has; {UNKNOWN}")


def _behind(array: Any, parts: tuple[Any, ...]) -> Any:
    """The part of an array that a mask chooses from: of all the axes of the mask, what further indices take."""
    mask = parts[0]
    if any(isinstance(part, Symbol | Symbols) for part in parts[1:]):
        raise TraceError("uses two masks at once, or a mask and a number that is not known yet; combine them by `&`")
    if not all(isinstance(part, int | np.integer | slice | type(Ellipsis)) for part in parts[1:]):
        raise TraceError(f"uses a mask beside other indices than numbers and slices; {UNKNOWN}")
    if np.shape(array)[: mask.ndim] != np.shape(mask):
        raise TraceError(f"uses a mask of shape {np.shape(mask)} for an array of shape {np.shape(array)}")
    return np.ndarray.__getitem__(array, (slice(None),) * mask.ndim + parts[1:])


def taken(array: Any, parts: tuple[Any, ...]) -> Masked:
    """``array[mask]`` and ``array[mask, ...]``."""
    return Masked(parts[0].copy(), _behind(array, parts).copy())


def put(array: Any, parts: tuple[Any, ...], value: Any) -> None:
    """``array[mask] = value`` and ``array[mask, ...] = value``: a choice for every entry."""
    mask, part = parts[0], _behind(array, parts)
    entries = value.of(mask) if isinstance(value, Masked) else value
    rest = part.ndim - mask.ndim
    if not isinstance(value, Masked) and np.ndim(entries) > rest:
        if np.size(entries) != 1:
            raise TraceError(f"puts an array where a mask holds; {UNKNOWN}")
        entries = np.asarray(plain(entries), dtype=object).item()
    spread = np.broadcast_to(np.asarray(plain(entries), dtype=object), part.shape)
    conditions = plain(mask).reshape(mask.shape + (1,) * rest)
    cast = as_truth if is_mask(part) else as_number
    pick = np.frompyfunc(lambda condition, new, old: choose(condition, cast(new), old), 3, 1)
    np.ndarray.__setitem__(part, Ellipsis, pick(conditions, spread, plain(part)))
