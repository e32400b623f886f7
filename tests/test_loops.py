"""Copies of an expression become loops: the numbers are those of straight lines of instructions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from calls import calls_of
from unifg.factors.autodiff import loops
from unifg.factors.autodiff.emit import _Writer
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.autodiff.tape import Tape
from unifg.factors.kernel import evaluate_rows
from unifg.lie import SE2, Manifold, Rn
from unifg.typing import Array

Function = Callable[[Array, Array, Array], Array]


def distances(x: Array, c: Array, r: Array) -> Array:
    offset = x[:, None, :2] - c
    return np.asarray(np.sqrt(np.sum(offset * offset, axis=-1)) - r)


def softest(x: Array, c: Array, r: Array) -> Array:
    """A sum of sums: weights that add up to one."""
    weight = np.exp(-distances(x, c, r))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def alternating(x: Array, c: Array, r: Array) -> Array:
    """Rows of two kinds in turn, with comparisons and functions of the C library."""
    offset = x[:, None, :2] - c
    return np.asarray(np.where(offset > 0.3, np.sin(offset), np.abs(offset) * r[..., None]).reshape(len(x), -1))


def mixed(x: Array, c: Array, r: Array) -> Array:
    """Rows that are no copies between others that are, and rows that are all the same."""
    near = np.minimum(distances(x, c, r), 1.0)
    return np.concatenate([distances(x, c, r), x[:, ::-1], near, x[:, :1] * np.ones((1, 7))], axis=1)


def signed(x: Array, c: Array, r: Array) -> Array:
    """Sums whose terms are added and taken off, in reverse, beside others."""
    inverse = 1.0 / (2.0 + distances(x, c, r) ** 2)
    found: Array = (x[:, :1] ** 2 - inverse[:, ::-1].sum(axis=1, keepdims=True)) * x[:, 1:2]
    return np.concatenate([found, (r * x[:, :1]).sum(axis=1, keepdims=True) - 3.0], axis=1)


def chained(x: Array, c: Array, r: Array) -> Array:
    """Each row depends on the one before: nothing here is a copy."""
    rows, last = [], x[:, 0]
    for k in range(c.shape[1]):
        last = np.tanh(last + c[:, k, 0] * r[:, k])
        rows.append(last)
    return np.stack(rows, axis=1)


def numbers(function: Function, manifold: Manifold, count: int) -> tuple[Array, Array, Array, Array]:
    """Rows without and with slopes, slopes, and second derivatives, as machine code has them."""
    rng = np.random.default_rng(1)
    given = manifold.random(rng, (1,)), np.ones((1, count, 2)), np.ones((1, count))
    rows = np.asarray(function(*given)).size
    kernel = StatedKernel(function, (manifold, (count, 2), (count,)), rows, name="tried")
    v, p, width = manifold.random(rng, (20,)), rng.normal(size=(20, 3 * count)) + 1.0, manifold.dim
    alone, r = np.zeros((20, rows)), np.zeros((20, rows))
    J, S = np.ones((20, rows, width)), np.zeros((20, width, width))
    evaluate_rows(kernel.address, v, p, kernel.table, alone, np.zeros((0, 0, width)))
    evaluate_rows(kernel.address, v, p, kernel.table, r, J)
    if kernel.second_address:
        evaluate_rows(kernel.second_address, v, p, kernel.table, rng.normal(size=(20, rows)), S)
    return alone, r, J, S


@pytest.mark.parametrize("count", [loops.FEWEST, 9, 16])
@pytest.mark.parametrize("manifold", [SE2, Rn(3)], ids=lambda m: m.name)
@pytest.mark.parametrize("function", [distances, softest, alternating, mixed, signed, chained])
@pytest.mark.product(3)
def test_loops_compute_what_straight_lines_do(
    function: Function, manifold: Manifold, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNIFG_KEEP_CODE", "0")
    written = calls_of(monkeypatch, _Writer, "loop")
    looped = numbers(function, manifold, count)
    assert bool(written) == (function is not chained)
    monkeypatch.setattr(loops, "FEWEST", 10_000)
    written.clear()
    straight = numbers(function, manifold, count)
    assert not written
    np.testing.assert_array_equal(looped[0], looped[1])
    np.testing.assert_array_equal(looped[0], straight[0])
    for mine, other in zip(looped[2:], straight[2:], strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-11, atol=1e-12 * max(1.0, float(np.abs(other).max())))


def parameters(tape: Tape, places: list[int]) -> list[int]:
    return [tape.leaf(Op.PARAMETER, place) for place in places]


def test_copies_lie_at_equal_strides() -> None:
    """One leaf out of place, another operation or an invariant that is another node: no copy."""
    tape = Tape()
    x = tape.leaf(Op.VARIABLE, 0)
    good = [tape.multiply(x, p) for p in parameters(tape, [3 * k + 1 for k in range(8)])]
    assert loops.Template(tape, 8).add(good) is not None
    assert loops.Repeats(tape, good).rows(good) == [range(8)]
    shifted = [*good[:7], tape.multiply(x, tape.leaf(Op.PARAMETER, 23))]
    assert loops.Template(tape, 8).add(shifted) is None
    assert loops.Repeats(tape, shifted).rows(shifted) == [range(7)]
    another = tape.multiply(tape.leaf(Op.VARIABLE, 1), tape.leaf(Op.PARAMETER, 22))
    assert loops.Template(tape, 8).add([*good[:7], another]) is None
    assert loops.Template(tape, 8).add([*good[:7], tape.add(x, tape.leaf(Op.PARAMETER, 22))]) is None
    assert loops.Repeats(tape, good).rows(good[: loops.FEWEST - 1]) == []


def test_copies_are_compared_once() -> None:
    """Sixty squares of squares, of which one begins elsewhere: either factor of each would be compared again."""
    tape = Tape()
    towers = parameters(tape, [*range(7), 9])
    for _ in range(60):
        towers = [tape.multiply(tower, tower) for tower in towers]
    template = loops.Template(tape, 8)
    assert template.add(towers[:7]) is not None and template.add(towers) is None
    x = tape.leaf(Op.VARIABLE, 0)  # a sum whose first term is the second one's in the last copy, by the order of nodes
    early = tape.apply(Op.SIN, tape.leaf(Op.PARAMETER, 107))
    sums = [
        tape.add(tape.multiply(x, tape.leaf(Op.PARAMETER, k)), tape.apply(Op.SIN, tape.leaf(Op.PARAMETER, 100 + k)))
        for k in range(8)
    ]
    assert tape.a[sums[7]] == early != tape.a[sums[6]] == tape.multiply(x, tape.leaf(Op.PARAMETER, 6))
    assert loops.Repeats(tape, sums).rows(sums) == [range(8)]


def test_what_ends_depend_on_is_not_live() -> None:
    tape = Tape()
    a, b = parameters(tape, [0, 1])
    inner = tape.apply(Op.SIN, a)
    outer = tape.add(tape.apply(Op.COS, inner), b)
    assert a in tape.live([outer]) and a not in tape.live([outer], {inner}) and inner in tape.live([outer], {inner})


def test_sums_that_are_wanted_elsewhere_are_terms() -> None:
    """A partial sum with another user is one number; a deep expression ends no process."""
    tape = Tape()
    terms = [tape.apply(Op.SIN, p) for p in parameters(tape, list(range(16)))]
    partial = tape.zero
    for term in terms[:8]:
        partial = tape.add(partial, term)
    whole = partial
    for term in terms[8:]:
        whole = tape.subtract(whole, term)
    found = loops.Repeats(tape, [whole, tape.apply(Op.COS, partial)]).sums
    assert set(found) == {whole, partial}
    assert found[whole].first == [(partial, False)] and found[whole].terms == [(found[whole].terms[0][0], True)]
    alone = loops.Repeats(tape, [whole]).sums
    assert set(alone) == {whole} and alone[whole].first == alone[whole].last == [] and len(alone[whole].terms) == 2
    deep = parameters(tape, list(range(8)))
    for _ in range(3000):
        deep = [tape.apply(Op.SIN, node) for node in deep]
    assert loops.Repeats(tape, deep).rows(deep) == []
