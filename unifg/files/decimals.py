"""Decimals in text to the nearest float64, many at once: the same numbers as ``float`` makes, bit by bit.

Up to 19 digits w and a power of ten q are read as w 10^q. Where w and 10^|q| are exact in float64, one operation rounds
correctly (W. Clinger, "How to read floating point numbers accurately", PLDI 1990). Otherwise w is multiplied by 128
bits of 5^q (D. Lemire, "Number parsing at a gigabyte per second", Software: Practice and Experience 51(8), 2021), which
always suffices in this range of q (N. Mushtak, D. Lemire, "Fast number parsing without fallback", 2023). Words of any
other form are left to the caller: more digits, other exponents, and what is no number.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from unifg.codegen.jit import compiled, in_order
from unifg.typing import Array, BoolArray, IntArray

__all__ = ()  # for readers only

DIGITS = 19  # of a number below 2^64
REACH = 60  # largest |q|
EXACT = 22  # 10^22 is the largest power of ten that float64 holds


def _five(exponent: int) -> tuple[int, int]:
    """The first 128 bits of 5^q, cut off where q >= 0, and rounded up where it is a reciprocal: high and low half."""
    if exponent >= 0:
        whole = 5**exponent
        whole = whole << 128 >> whole.bit_length()
    else:
        power = 5**-exponent
        whole = (1 << (power.bit_length() + 127)) // power + 1
    return whole >> 64, whole & (2**64 - 1)


FIVES = np.array([_five(exponent) for exponent in range(-REACH, REACH + 1)], dtype=np.uint64)
TENS: Array = np.array([float(10**exponent) for exponent in range(EXACT + 1)])


@compiled
def is_blank(byte: int) -> bool:
    """Test whether a byte separates words within a line."""
    return byte == 32 or byte == 9 or byte == 13


@in_order
def parse_fields(
    data: NDArray[np.uint8],
    begin: IntArray,
    end: IntArray,
    leading: int,
    whole: NDArray[np.int64],
    numbers: Array,
    strange: BoolArray,
) -> int:
    """Read lines of one form: words, of which the first are integers of 64 bits.

    Args:
        data: bytes of the text.
        begin: (n,) where the lines stand in it.
        end: (n,) where they end.
        leading: number of integers, k.
        whole: (n, k) takes them.
        numbers: (n, m) takes the numbers that follow.
        strange: (n, k + m) is set for words that are neither; what stands in their places means nothing.

    Returns:
        The first line that does not have k + m words, or -1.
    """
    width = leading + numbers.shape[1]
    for line in range(len(begin)):
        at, stop, count = begin[line], end[line], 0
        while True:
            while at < stop and is_blank(data[at]):
                at += 1
            if at >= stop:
                break
            if count < leading:
                at, whole[line, count] = _integer(data, at, stop)
            elif count < width:
                at, numbers[line, count - leading] = _number(data, at, stop)
            if at < 0 or (at < stop and not is_blank(data[at])):  # no number begins or goes on like this
                at = ~at if at < 0 else at
                if count < width:
                    strange[line, count] = True
                while at < stop and not is_blank(data[at]):
                    at += 1
            count += 1
        if count != width:
            return line
    return -1


@in_order
def _digits(data: NDArray[np.uint8], at: int, stop: int, point: int) -> tuple[int, np.uint64, int]:
    """Read a row of digits, and one point among them where `point` is negative.

    Returns:
        Where it ends, its value modulo 2^64 without the point, and where the point stands; `point` if there is none.
    """
    found = np.uint64(0)
    while at < stop:
        digit = np.uint64(data[at]) - np.uint64(48)  # huge where a byte comes before "0"
        if digit <= np.uint64(9):
            found = found * np.uint64(10) + digit
        elif point < 0 and data[at] == 46:
            point = at
        else:
            break
        at += 1
    return at, found, point


@in_order
def _integer(data: NDArray[np.uint8], at: int, stop: int) -> tuple[int, np.int64]:
    """An integer whose size has 63 bits: where it ends, ~begin where there is something else, and its value."""
    begin = at
    negative = data[at] == 45
    if negative or data[at] == 43:
        at += 1
    first = at
    at, found, _ = _digits(data, at, stop, at)
    if at == first or at - first > DIGITS or found >= np.uint64(2**63):
        return ~begin, np.int64(0)
    return at, -np.int64(found) if negative else np.int64(found)


@in_order
def _number(data: NDArray[np.uint8], at: int, stop: int) -> tuple[int, float]:
    """The float64 nearest to a decimal: where it ends, ~begin where there is something else, and its value."""
    begin = at
    negative = data[at] == 45
    if negative or data[at] == 43:
        at += 1
    first, scale = at, np.int64(0)
    at, digits, point = _digits(data, at, stop, -1)
    read = at - first
    if point >= 0:
        scale -= at - point - 1
        read -= 1
    if read == 0:
        return ~begin, 0.0
    if read > DIGITS:  # zeros at the front do not count
        place = first
        while read > DIGITS and place < at and (data[place] == 48 or data[place] == 46):
            if data[place] == 48:
                read -= 1
            place += 1
        if read > DIGITS:
            return ~begin, 0.0
    if at < stop and (data[at] == 101 or data[at] == 69):  # e, E
        at += 1
        downwards = at < stop and data[at] == 45
        if downwards or (at < stop and data[at] == 43):
            at += 1
        first = at
        at, exponent, _ = _digits(data, at, min(stop, at + 5), at)  # more digits are no end of a word
        if at == first:
            return ~begin, 0.0
        scale += -np.int64(exponent) if downwards else np.int64(exponent)
    if digits == np.uint64(0):
        value = 0.0
    elif digits <= np.uint64(2**53) and -EXACT <= scale <= EXACT:
        value = float(digits) * TENS[scale] if scale >= 0 else float(digits) / TENS[-scale]
    elif -REACH <= scale <= REACH:
        value = _rounded(digits, scale)
    else:
        return ~begin, 0.0
    return at, -value if negative else value


@in_order
def _rounded(digits: np.uint64, scale: np.int64) -> float:
    """The float64 nearest to digits 10^scale, digits > 0, |scale| <= REACH, far from overflow and underflow."""
    empty = 0
    while digits < np.uint64(2**63):
        digits = digits << np.uint64(1)
        empty += 1
    high, low = _product(digits, FIVES[scale + REACH, 0])
    if (high & np.uint64(0x1FF)) == np.uint64(0x1FF):  # what is cut off could reach the bits that decide
        more, _ = _product(digits, FIVES[scale + REACH, 1])
        low = low + more
        if more > low:
            high = high + np.uint64(1)
    upper = high >> np.uint64(63)
    shift = upper + np.uint64(9)
    mantissa = high >> shift  # 53 bits and one that decides
    # floor(scale log2 10), and where the 53 bits of the mantissa stand
    exponent = ((217706 * scale) >> 16) + np.int64(upper) - empty + 11
    halfway = low <= np.uint64(1) and -4 <= scale <= 23 and (mantissa & np.uint64(3)) == np.uint64(1)
    if halfway and (mantissa << shift) == high:
        mantissa = mantissa & ~np.uint64(1)  # to even
    mantissa = (mantissa + (mantissa & np.uint64(1))) >> np.uint64(1)
    return math.ldexp(float(mantissa), int(exponent))


@in_order
def _product(a: np.uint64, b: np.uint64) -> tuple[np.uint64, np.uint64]:
    """High and low half of the product of two numbers of 64 bits."""
    half, lower = np.uint64(32), np.uint64(0xFFFFFFFF)
    a_high, a_low, b_high, b_low = a >> half, a & lower, b >> half, b & lower
    first, second, third = a_low * b_low, a_low * b_high, a_high * b_low
    middle = (first >> half) + (second & lower) + (third & lower)
    high = a_high * b_high + (second >> half) + (third >> half) + (middle >> half)
    return high, (first & lower) | (middle << half)
