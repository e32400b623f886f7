"""Decimals read by compiled code: the numbers that ``float`` makes, bit by bit, and no others."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from unifg.files.decimals import parse_fields
from unifg.typing import Array, BoolArray


def parse(words: list[str], leading: int = 0) -> tuple[Array, Array, BoolArray]:
    """One line of words: integers, numbers, and which are neither."""
    text = " ".join(words).encode()
    whole, numbers = np.zeros((1, leading), dtype=np.int64), np.zeros((1, len(words) - leading))
    strange = np.zeros((1, len(words)), dtype=np.bool_)
    place = np.zeros(1, dtype=np.intp), np.array([len(text)])
    assert parse_fields(np.frombuffer(text, np.uint8), *place, leading, whole, numbers, strange) == -1
    return whole[0], numbers[0], strange[0]


def same(words: list[str], most_strange: float = 0.0) -> None:
    """The same bits as ``float`` wherever a word was read."""
    _, found, strange = parse(words)
    wanted = np.array([float(word) for word in words])
    assert strange.mean() <= most_strange
    wrong = np.flatnonzero((found.view(np.uint64) != wanted.view(np.uint64)) & ~strange)
    assert not len(wrong), [words[k] for k in wrong[:5]]


def test_shortest_decimals_come_back(rng: np.random.Generator) -> None:
    values = rng.normal(size=20_000) * 10.0 ** rng.uniform(-40, 40, 20_000)
    same([repr(value) for value in values.tolist()])
    same([f"{value:.6f}" for value in rng.uniform(-100, 100, 5000).tolist()])


def test_any_digits_and_exponents(rng: np.random.Generator) -> None:
    digits = ["".join(map(str, rng.integers(0, 10, rng.integers(1, 20)))) for _ in range(20_000)]
    same([f"{word}e{exponent}" for word, exponent in zip(digits, rng.integers(-41, 41, 20_000), strict=True)])


def test_halves_go_to_even(rng: np.random.Generator) -> None:
    words = []
    for power in range(-3, 10):  # where half a step takes at most 19 digits
        for mantissa in rng.integers(2**52, 2**53, 200).tolist():
            half = (2 * mantissa + 1) * Fraction(2) ** power * 10 ** max(-power, 0)
            words += [f"{half.numerator + near}e-{max(-power, 0)}" for near in (-1, 0, 1)]
    same(words)
    same(["9007199254740993", "9007199254740995", "9007199254740993e1", "1e23", "8.5e22", "123456789012345678"])
    same(["18446744073709551615e-20", "9999999999999999999"], most_strange=0.5)


def test_every_form_of_a_number() -> None:
    same(["-0", "+0.0", "-0e5", "1.", ".5", "-.5e1", "1E5", "1e+5", "007", "5e-60", "0.0000000000000000000000000015"])
    for word in ("1e", "e5", ".", "-", "+-1", "1_0", "nan", "inf", "0x10", "1..2", "--1", "1e+", "1e5.", "1,5", "1-"):
        assert parse([word, "2.5"])[2].tolist() == [True, False], word
        assert parse([word, "2.5"])[1][1] == 2.5
    beyond = ["1" * 20, "1e61", "1e-300", "0." + "3" * 30]  # numbers, but for the caller to read
    assert parse(beyond)[2].all()


@pytest.mark.parametrize("word", ["0", "-7", "+12", str(2**63 - 1), str(-(2**63) + 1), "000000000000000001"])
def test_integers_of_64_bits(word: str) -> None:
    whole, numbers, strange = parse([word, "1.5"], leading=1)
    assert whole.tolist() == [int(word)] and numbers.tolist() == [1.5] and not strange.any()


@pytest.mark.parametrize("word", [str(2**63), "9" * 20, "1.0", "1e3", "x", "-", "7x"])
def test_what_is_no_integer(word: str) -> None:
    assert parse([word, "1.5"], leading=1)[2].tolist() == [True, False]


def test_lines_of_another_length() -> None:
    text = b"1 2\n3 4 5\n6\n"
    data, begin, end = np.frombuffer(text, np.uint8), np.array([0, 4, 10]), np.array([3, 9, 11])
    for chosen, wrong in (([0], -1), ([0, 1], 1), ([0, 2], 1), ([2, 0], 0)):
        count = len(chosen)
        arrays = np.zeros((count, 1), dtype=np.int64), np.zeros((count, 1)), np.zeros((count, 2), dtype=np.bool_)
        assert parse_fields(data, begin[chosen], end[chosen], 1, *arrays) == wrong
    assert math.isclose(arrays[1][0, 0], 0.0)
