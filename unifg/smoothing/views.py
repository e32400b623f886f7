"""Arrays that are looked at without being counted.

Compiled functions count references to every array they are handed, with two atomic operations each; a smoother hands
nine arrays to functions that work for a few nanoseconds. A view that owns nothing is not counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba.core import cgutils
from numba.extending import intrinsic

from unifg.machine.jit import compiled
from unifg.smoothing.fields import State


def _borrowed(typing_context: Any, array: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = signature.args[0]
        view = context.make_array(kind)(context, builder, values[0])
        view.meminfo = cgutils.get_null_value(view.meminfo.type)
        view.parent = cgutils.get_null_value(view.parent.type)
        return view._getvalue()

    return array(array), generate


borrowed = cast(Callable[[Any], Any], intrinsic(_borrowed))
"""The same array, good for as long as someone else keeps it."""


@compiled
def borrow(state: State) -> State:
    """All arrays of a state, good for as long as the caller keeps the state."""
    return State(
        borrowed(state.variables),
        borrowed(state.factors),
        borrowed(state.types),
        borrowed(state.kinds),
        borrowed(state.cliques),
        borrowed(state.counters),
        borrowed(state.stamps),
        borrowed(state.lists),
        borrowed(state.numbers),
    )
