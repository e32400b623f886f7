"""The operations of a tape: numbers for compiled passes, names for people, and what each computes."""

from __future__ import annotations

from enum import IntEnum, auto


class Op(IntEnum):
    """Operation of a node of a tape on its arguments a, b, c."""

    CONSTANT = 0
    VARIABLE = auto()  # a-th number of the variables' storage
    PARAMETER = auto()  # a-th parameter
    WEIGHT = auto()  # a-th weight of the rows
    TANGENT = auto()  # a-th tangent coordinate, zero once everything is differentiated
    NEGATE = auto()
    ADD = auto()
    SUBTRACT = auto()
    MULTIPLY = auto()
    DIVIDE = auto()
    SQRT = auto()
    SIN = auto()
    COS = auto()
    TAN = auto()
    ARCSIN = auto()
    ARCCOS = auto()
    ARCTAN = auto()
    ARCTAN2 = auto()
    SINH = auto()
    COSH = auto()
    TANH = auto()
    ARCSINH = auto()
    ARCCOSH = auto()
    ARCTANH = auto()
    ERF = auto()
    EXP = auto()
    EXPM1 = auto()
    LOG = auto()
    LOG1P = auto()
    POWER = auto()
    FMOD = auto()  # what whole multiples of b leave of a, with the sign of a
    ABSOLUTE = auto()
    SIGN = auto()
    FLOOR = auto()
    RINT = auto()
    MINIMUM = auto()
    MAXIMUM = auto()
    LESS = auto()
    LESS_EQUAL = auto()
    EQUAL = auto()
    AND = auto()
    OR = auto()
    NOT = auto()
    SELECT = auto()  # b where a, else c
    GATHER = auto()  # the a-th number of the tables
    LIST = auto()  # the list a, and b; a list begins where a is none
    SOLVE = auto()  # all of x in A x = b, for a list of the rows of A and b
    ENTRY = auto()  # the b-th of the solution a
    SEARCH = auto()  # interval of a, from 0 to c - 2, among c increasing numbers that begin at b
    TAKE = auto()  # the a-th of c parameters that begin at b


UNARY = frozenset(
    {
        Op.NEGATE, Op.SQRT, Op.SIN, Op.COS, Op.TAN, Op.ARCSIN, Op.ARCCOS, Op.ARCTAN, Op.SINH, Op.COSH, Op.TANH,
        Op.ARCSINH, Op.ARCCOSH, Op.ARCTANH, Op.ERF, Op.EXP, Op.EXPM1, Op.LOG, Op.LOG1P, Op.ABSOLUTE, Op.SIGN, Op.FLOOR,
        Op.RINT, Op.NOT, Op.GATHER,
    }
)  # fmt: skip
STEADY = frozenset(
    {
        Op.SIGN, Op.FLOOR, Op.RINT, Op.LESS, Op.LESS_EQUAL, Op.EQUAL, Op.AND, Op.OR, Op.NOT, Op.GATHER, Op.SEARCH,
        Op.TAKE,
    }
)  # fmt: skip
"""Constant but where they jump: they have no derivatives."""
GROUPED = frozenset({Op.LIST, Op.SOLVE})
"""Several numbers: their derivatives are those of their entries."""
