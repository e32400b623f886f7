"""State of a smoother between updates: tables of records, and two arenas for everything of varying length.

Compiled code takes the address of a description of all arrays, so an update is one call. A clique is a group of
variables that are eliminated together; it keeps its whole front: rows of the factor, and the update matrix it passed to
its parent. Chains run through the tables: a counter, or a field of another record, has the first, every record the
next, and -1 ends it.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np

from unifg.codegen.jit import inlined
from unifg.codegen.vectors import Address
from unifg.codegen.views import opener
from unifg.typing import Array, IntArray, Records

Record: TypeAlias = Any  # one of them, inside compiled code


def _record(*names: str, **numbers: type) -> np.dtype[np.void]:
    """Integers of these names, and numbers of other kinds."""
    return np.dtype([(name, np.int64) for name in names] + list(numbers.items()), align=True)


VARIABLE = _record(
    "part",  # first part of its manifold in State.parts
    "parts",
    "dim",  # of its tangent space
    "storage",  # numbers that store a value
    "value",  # where its numbers stand: linearisation point, step, step last passed downwards, scale of its diagonal
    "clique",  # in which it is eliminated; -1: none yet
    "place",  # first row in the front of that clique
    "length",  # of its numbers
    "link",  # first of the chain of its factors, factor * SLOTS_MAX + slot
    "mark",  # number of the update that re-eliminates it
    "local",  # its number within that update
    "changed",  # number of the update that moved it by more than the threshold of back-substitution
    "frozen",  # 1: a prior keeps its linearisation point, 2: a prior must be told when it moves
    "candidate",  # 1: in the chain of variables that may have to be relinearised
    "next_candidate",
    "next",  # in the chain of new variables, or of free rows
    "sequence",  # order of creation
    "family",  # for messages
    "member",
    "alive",
    stamp=np.float64,  # age: the older are eliminated first when the order is chronological
)
PART = _record(
    "retraction",  # address; 0: a vector; BY_PYTHON: the estimate follows the numbers of the variable
    "deviation",  # address of the residual of a prior; BY_PYTHON: its derivative follows the estimate
    "start",  # first number of its storage
    "storage",
    "tangent",  # first number of its step
    "dim",
)
SLOT = _record(  # what a factor reads of one of its variables
    "start",  # in its storage
    "storage",
    "tangent",  # in its tangent space
    "dim",
)
TYPE = _record(  # of factors
    "address",  # of the kernel; 0: evaluated by Python
    "rows",
    "slot",  # first slot in State.slots
    "slots",  # variables
    "width",  # tangent columns
    "parameters",  # numbers that the kernel takes
    "table",  # address of its shared table
    "table_size",
    "whitening",  # 0, DIAGONAL or FULL
    "loss",  # formula of its loss, whose parameters are the last two
    "numbers",  # that describe a factor: parameters, then the whitener
    first=np.float64,
    second=np.float64,
)
FACTOR = _record(
    "type",
    "variables",  # where its variables stand in State.lists, followed by one link for each
    "data",  # where its numbers stand, followed by the upper triangle of [J'J, J'r]
    "state",  # FRESH, LINEAR or STALE
    "next",  # in the chain of new factors, or of free rows
    "used",
    "batch",  # number of the statement it belongs to, where Python evaluates it
    "item",  # its number there
)
CLIQUE = _record(
    "list",  # where its variables stand in State.lists, pivots first
    "count",  # variables
    "pivots",  # of them
    "pivot_rows",  # scalars of the pivots
    "size",  # scalars of all
    "stride",  # of the rows of its front
    "front",  # where its front stands
    "parent",  # -1: a root
    "child",  # first
    "sibling",  # next
    "marked",  # number of the update that dissolves it
    "next",  # in the chain of dissolved cliques, or of free rows
    "prior",  # 1: its pivots were marginalised, only the update matrix counts
    "filled",  # 1: in use
)
MADE = ("eliminated", "relinearized", "substituted", "linearized", "marginalized", "largest")  # by the last update
COUNTERS = _record(
    "variable_end",  # rows in use end here
    "variable_free",  # chain of free rows
    "factor_end",
    "factor_free",
    "clique_end",
    "clique_free",
    "lists_end",
    "numbers_end",
    "new_variables",  # chains
    "new_factors",
    "candidates",
    "updates",  # so far
    "sequences",
    "failed",  # variable whose pivot vanished; -1: none
    *MADE,
    "scratch",  # numbers that a factor needs while it is evaluated
)
PLACE = {name: place for place, name in enumerate(COUNTERS.names or ())}  # all are integers
CHAINS = (
    "variable_free", "factor_free", "clique_free", "new_variables", "new_factors", "candidates", "failed",
)  # fmt: skip

BY_PYTHON = -1  # in the place of an address
FRESH, LINEAR, STALE = range(3)  # never linearised; as it should be; at an old point
SLOTS_MAX = 1 << 20  # more variables than any factor has
CLASSES = 160  # of blocks in an arena


class State(NamedTuple):
    """All arrays of a smoother.

    Attributes:
        variables: VARIABLE.
        factors: FACTOR.
        types: TYPE.
        slots: SLOT, of all types.
        parts: PART, of all manifolds.
        cliques: CLIQUE.
        counters: (1,) COUNTERS.
        heads: (2 CLASSES,) of the free blocks of the two arenas.
        lists: arena of integers.
        numbers: arena of floats.
    """

    variables: Records
    factors: Records
    types: Records
    slots: Records
    parts: Records
    cliques: Records
    counters: Records
    heads: IntArray
    lists: IntArray
    numbers: Array


_INTEGERS, _FLOATS = np.dtype(np.int64), np.dtype(np.float64)
_open = opener(State, (VARIABLE, FACTOR, TYPE, SLOT, PART, CLIQUE, COUNTERS, _INTEGERS, _INTEGERS, _FLOATS))


@inlined
def opened(memory: Address) -> State:
    """The arrays whose description stands at an address, see :func:`unifg.codegen.views.described`."""
    return _open(memory)


def empty_state() -> State:
    """Nothing, with room: memory is only taken when it is written, and growing costs an update milliseconds."""
    counters = np.zeros(1, dtype=COUNTERS)
    for chain in CHAINS:
        counters[chain] = -1
    rows = 256
    return State(
        np.zeros(rows, dtype=VARIABLE),
        np.zeros(rows, dtype=FACTOR),
        np.zeros(8, dtype=TYPE),
        np.zeros(0, dtype=SLOT),
        np.zeros(0, dtype=PART),
        np.zeros(2 * rows, dtype=CLIQUE),
        counters,
        np.full(2 * CLASSES, -1),
        np.empty(1 << 16, dtype=np.int64),
        np.empty(1 << 21),
    )
