"""A prepared graph as a function for JAX, under ``jit``, ``grad`` and ``vmap``; of the extra ``jax``.

solve = unifg.jax.layer(run, [weight], [x], guess)
slope = jax.grad(lambda numbers: ((solve(numbers) - wanted) ** 2).sum())(numbers)
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from unifg.errors import GraphError
from unifg.layers import Answers, Layer
from unifg.typing import Array

__all__ = ["layer"]

REMEMBERED = 8  # answers whose slopes may be asked for without another solve


def layer(*args: Any, **options: Any) -> Callable[..., Any]:
    """Function from arrays to values of families; arguments as of `unifg.layers.Layer`.

    Arrays have the shapes of the data, or (..., shape) for several instances. The result is the array of the output, a
    tuple of several, of the type of the first input; whole numbers count as JAX's default type of real ones. Shapes
    that do not fit raise a `GraphError`; what a solve raises comes as an error of JAX that quotes it.
    """
    inner = Layer(*args, **options)
    known: OrderedDict[bytes, Answers] = OrderedDict()

    def solved(given: tuple[Any, ...]) -> Answers:
        """Answers, solved anew unless these very arrays were among the last ones, with the other data as now."""
        arrays = [np.asarray(one, dtype=np.float64) for one in given]
        key = b"".join(repr(array.shape).encode() + array.tobytes() for array in (*arrays, *inner.others))
        if key not in known:
            known[key] = inner.solve(*arrays)
            while len(known) > REMEMBERED:
                known.popitem(last=False)
        return known[key]

    def answer(*given: Any) -> tuple[Array, ...]:
        return tuple(values.astype(given[0].dtype) for values in solved(given).values)

    def pull(given: tuple[Any, ...], slopes: tuple[Any, ...]) -> tuple[Array, ...]:
        found = inner.pull(solved(given), [np.asarray(slope, dtype=np.float64) for slope in slopes])
        return tuple(slope.astype(one.dtype) for slope, one in zip(found, given, strict=True))

    @jax.custom_vjp  # type: ignore[untyped-decorator]
    def solve(*given: Any) -> tuple[Any, ...]:
        lead, dtype = inner.together([one.shape for one in given])[0], given[0].dtype
        shapes = [(*lead, family.count, family.manifold.storage) for family in inner.outputs]
        results = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in shapes)
        return tuple(jax.pure_callback(answer, results, *given, vmap_method="broadcast_all"))

    def backward(given: tuple[Any, ...], slopes: tuple[Any, ...]) -> tuple[Any, ...]:
        results = tuple(jax.ShapeDtypeStruct(one.shape, one.dtype) for one in given)
        return tuple(jax.pure_callback(pull, results, given, slopes, vmap_method="broadcast_all"))

    solve.defvjp(lambda *given: (solve(*given), given), backward)

    def call(*given: Any) -> Any:
        arrays = [jax.numpy.asarray(one) for one in given]
        if any(map(jax.numpy.iscomplexobj, arrays)):
            raise GraphError("layer: data must be real numbers, found complex numbers: convert to real ones first")
        # all instances in front of each, so that an axis that vmap adds stands in the same place of all
        alike = map(jax.numpy.broadcast_to, arrays, inner.together([one.shape for one in arrays])[1])
        found = solve(*(one.astype(jax.numpy.result_type(one, float)) for one in alike))
        return found if len(found) > 1 else found[0]

    return call
