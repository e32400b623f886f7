"""What a smoother keeps between updates: tables of integers, and two arenas that everything of varying length lives in.

One tuple of arrays is all that compiled code needs, so an update is one call. A clique is a group of variables that
are eliminated together; it keeps its whole front: rows of the factor, and the update matrix it passed to its parent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.typing import Array, IntArray

(
    KIND,  # of a variable: where its retraction stands in State.kinds
    DIM,  # tangent dimension
    STORAGE,  # numbers that store a value
    VALUE,  # where its numbers stand: linearisation point, step, step last passed downwards, scale of its diagonal
    CLIQUE,  # in which it is eliminated; -1: none yet
    PLACE,  # first row in the front of that clique
    LINK,  # first of the chain of its factors, factor * SLOTS_MAX + slot; -1: none
    MARK,  # number of the update that re-eliminates it
    LOCAL,  # its number within that update
    CHANGED,  # number of the update that moved it by more than the threshold of back-substitution
    FROZEN,  # 1: a prior keeps its linearisation point, 2: a prior must be told when it moves
    CANDIDATE,  # 1: in the chain of variables that may have to be relinearised
    NEXT_CANDIDATE,
    NEXT,  # in the chain of new variables, or of free rows
    SEQUENCE,  # order of creation
    FAMILY,  # for messages
    MEMBER,
    ALIVE,
    VARIABLE_FIELDS,
) = range(19)

(
    ADDRESS,  # of the kernel of a type of factors
    ROWS,
    SLOTS,  # variables
    WIDTH,  # tangent columns
    PARAMETERS,  # numbers that a kernel takes
    TABLE,  # address of its shared table
    TABLE_SIZE,
    WHITENING,  # 0, DIAGONAL or FULL
    LOSS,  # robust loss, see unifg.smoothing.factors
    NUMBERS,  # that describe a factor: parameters, whitener, two of the loss
    TYPE_FIELDS,
) = range(11)

(
    TYPE,
    VARIABLES,  # where its variables stand in State.lists, followed by one link for each
    DATA,  # where its numbers stand, followed by the whitened residual and Jacobian
    STATE,  # FRESH, LINEAR or STALE
    NEXT_FACTOR,  # in the chain of new factors, or of free rows
    USED,
    FACTOR_FIELDS,
) = range(7)

FRESH, LINEAR, STALE = range(3)  # never linearised; as it should be; at an old point
SLOTS_MAX = 16

(
    LIST,  # of a clique: where its variables stand in State.lists, pivots first
    COUNT,  # variables
    PIVOTS,  # of them
    PIVOT_ROWS,  # scalars of the pivots
    SIZE,  # scalars of all
    STRIDE,  # of the rows of its front
    FRONT,  # where its front stands
    PARENT,  # -1: a root
    CHILD,  # first
    SIBLING,  # next
    MARKED,  # number of the update that dissolves it
    NEXT_CLIQUE,  # in the chain of dissolved cliques, of priors, or of free rows
    PRIOR,  # 1: its pivots were marginalised, only the update matrix counts
    FILLED,  # 1: in use
    CLIQUE_FIELDS,
) = range(15)

(
    VARIABLE_END,  # rows in use end here
    VARIABLE_FREE,  # chain of free rows
    FACTOR_END,
    FACTOR_FREE,
    CLIQUE_END,
    CLIQUE_FREE,
    LISTS_END,
    NUMBERS_END,
    NEW_VARIABLES,  # chains
    NEW_FACTORS,
    CANDIDATES,
    PRIORS,
    UPDATES,  # so far
    SEQUENCES,
    FAILED,  # variable whose pivot vanished; -1: none
    MADE_ELIMINATED,  # what the last update did: variables re-eliminated,
    MADE_RELINEARIZED,  # moved to a new linearisation point,
    MADE_SUBSTITUTED,  # and given a new step; factors linearised
    MADE_LINEARIZED,
    MADE_MARGINALIZED,
    LARGEST,  # clique made by the last update, in scalars
    SCRATCH,  # numbers that a factor needs while it is evaluated
    HEADS,  # of the free blocks of the arenas
) = range(23)
CLASSES = 160
COUNTERS = HEADS + 2 * CLASSES


class State(NamedTuple):
    """All arrays of a smoother.

    Attributes:
        variables: (V, VARIABLE_FIELDS).
        factors: (F, FACTOR_FIELDS).
        types: (T, TYPE_FIELDS).
        kinds: for each manifold the number of its parts, then for each part the addresses of its retraction and of the
            residual of a prior (0: a vector), first number of its storage, size, first of its tangent, dimension.
        cliques: (C, CLIQUE_FIELDS).
        counters: single numbers, and free lists of the arenas.
        stamps: (V,) age of each variable; the older are eliminated first when the order is chronological.
        lists: arena of integers.
        numbers: arena of floats.
    """

    variables: IntArray
    factors: IntArray
    types: IntArray
    kinds: IntArray
    cliques: IntArray
    counters: IntArray
    stamps: Array
    lists: IntArray
    numbers: Array


def empty_state() -> State:
    """Nothing, with room: memory is only taken when it is written, and growing costs an update milliseconds."""
    counters = np.zeros(COUNTERS, dtype=np.int64)
    counters[HEADS:] = -1
    for chain in (VARIABLE_FREE, FACTOR_FREE, CLIQUE_FREE, NEW_VARIABLES, NEW_FACTORS, CANDIDATES, PRIORS, FAILED):
        counters[chain] = -1
    rows = 256
    return State(
        np.zeros((rows, VARIABLE_FIELDS), dtype=np.int64),
        np.zeros((rows, FACTOR_FIELDS), dtype=np.int64),
        np.zeros((8, TYPE_FIELDS), dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros((2 * rows, CLIQUE_FIELDS), dtype=np.int64),
        counters,
        np.zeros(rows),
        np.empty(1 << 16, dtype=np.int64),
        np.empty(1 << 21),
    )
