"""Work queue: a compiled pass shared by threads that the interpreter's lock never stops.

A thread that would take a job in Python waits for the lock, is put to sleep for it, and comes tens of microseconds late
to a pass of hundreds. So helpers stay in one compiled loop that looks into a mailbox: five integers, of which the
address of a function and that of its arguments are what is to be done.

The first integer counts calls that were opened and closed: it is odd while one is open. Who wants to help says so, and
only then looks whether the call is still the one that was seen; who has called closes the call, and waits until as
many have left as have entered. So nobody works on what may be gone, and nobody is waited for who has not begun.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic

from unifg.codegen.function_pointers import ADDRESS, NOTHING, link, run
from unifg.codegen.jit import compiled
from unifg.codegen.vectors import INDEX, Address, address, advance, present
from unifg.typing import IntArray

__all__ = ["arguments_at", "arrays", "bundle", "empty_mailbox", "entrance", "lead", "serve"]

LINE = 8  # integers of a line of memory: who writes to one stops who reads another of the same line
POSTED, FUNCTION, ARGUMENTS, ENTERED, LEFT = 0, LINE, LINE + 1, 2 * LINE, 3 * LINE
PATIENCE = 2_000_000  # looks for a call, about two milliseconds


def arrays(dtype: Any, axes: int = 1) -> Any:
    """Type of contiguous arrays of a type of numbers."""
    return types.Array(dtype, axes, "C")


def bundle(form: Any, kinds: Sequence[Any]) -> Any:
    """Type of a named tuple of such arrays."""
    return types.NamedTuple(list(kinds), form)


def empty_mailbox() -> IntArray:
    """Mailbox without a call."""
    return np.zeros(4 * LINE, np.int64)


def _stored(typing: Any, arguments: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.ptrtoint(cgutils.alloca_once_value(builder, values[0]), INDEX)

    return types.int64(arguments), generate


_store = cast(Callable[[Any], Address], intrinsic(_stored))  # on the stack of the caller


def arguments_at(kinds: Sequence[Any]) -> Callable[[Address], Any]:
    """Function for a compiled pass that finds its arguments, of these types, by the address it is given."""
    whole = types.Tuple(list(kinds))

    def found(typing: Any, where: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            place = builder.inttoptr(values[0], context.get_value_type(whole).as_pointer())
            return impl_ret_borrowed(context, builder, whole, builder.load(place))

        return whole(types.int64), generate

    return cast(Callable[[Address], Any], intrinsic(found))


def entrance(share: Callable[[Address], None]) -> Address:
    """Address of a compiled pass that takes the address of its arguments, which the caller keeps alive."""
    return link(share, NOTHING, ADDRESS)


@compiled
def lead(mailbox: IntArray, share: Address, arguments: tuple[Any, ...]) -> None:
    """Do a pass with all who look into the mailbox, and return when nobody is at it any more.

    Args:
        mailbox: of one caller at a time.
        share: entrance of the pass, in which threads share the work out among themselves.
        arguments: of the pass.
    """
    where = address(mailbox)
    mailbox[FUNCTION], mailbox[ARGUMENTS] = share, _store(arguments)
    advance(where, POSTED)
    run(share, (mailbox[ARGUMENTS],))
    advance(where, POSTED)
    # In this order: whoever enters and leaves in between must not stand for one who is still inside.
    while present(where, LEFT) != present(where, ENTERED):
        pass


@compiled
def serve(mailbox: IntArray, seen: int) -> int:
    """Help with all calls until none has come for a while.

    Args:
        mailbox: see above.
        seen: the call that was helped with last.

    Returns:
        The same now.
    """
    where, looks = address(mailbox), 0
    while looks < PATIENCE:
        call = present(where, POSTED)
        looks += 1
        if call % 2 == 1 and call != seen:
            advance(where, ENTERED)
            if present(where, POSTED) == call:
                run(present(where, FUNCTION), (present(where, ARGUMENTS),))
                seen, looks = call, 0
            advance(where, LEFT)
    return seen
