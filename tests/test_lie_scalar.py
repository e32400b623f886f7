"""The compiled functions of one element, the loops over them, and the functions of an angle they share."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from math import comb, factorial
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator

from groups import PI
from unifg.errors import UnifgError
from unifg.lie import SE2, SE3, SO2, SO3, LieGroup, Product, Rn, check_manifold, rn, se3, series, so2
from unifg.lie.elementwise import over_one, over_two
from unifg.lie.functions import functions_of
from unifg.typing import Array, ArrayLike

PARTS: list[LieGroup] = [
    Product(p=Rn(3), R=SO3, v=Rn(3)),
    Product(turn=SO2),
    Product(inner=Product(x=SE2, y=Rn(1)), outer=Product(deep=Product(z=SE3), r=SO2)),
]


@pytest.mark.parametrize("group", PARTS, ids=str)
@pytest.mark.product(1, of="studies")
def test_one_element_and_a_batch_of_products_agree(group: LieGroup) -> None:
    """Of the groups themselves `test_own_manifolds.test_axioms_hold` compares them."""
    report = check_manifold(group)
    assert report.ok, str(report)
    assert "the compiled right_jacobian agrees with the batched one" in report.tried
    assert "the compiled compose may write over argument 1" in report.tried


class Inheriting(type(SO2)):  # type: ignore[misc]
    """A group that states nothing of its own."""


class Unknown(type(SO2)):  # type: ignore[misc]
    """A group that moves by NumPy."""

    def retract(self, x: ArrayLike, d: ArrayLike, /) -> Array:
        return SO2.retract(x, d)


def test_functions_of_products() -> None:
    assert functions_of(Product(a=SE2, b=Rn(2))) is functions_of(Product(a=SE2, b=Rn(2)))
    assert functions_of(Product(a=SO2, b=Rn(1))) is not functions_of(Product(a=Rn(1), b=SO2))
    assert functions_of(Unknown()) is None and functions_of(Product(a=SE2, b=Product(c=Unknown()))) is None


def test_functions_are_those_of_the_methods() -> None:
    functions, of_vectors, inherited = functions_of(SE3), functions_of(Rn(2)), functions_of(Inheriting())
    assert functions is not None and of_vectors is not None and inherited is not None
    assert functions.exp is se3.exp and of_vectors.retract is rn.add
    assert inherited.retract is so2.compose
    with pytest.raises(AttributeError, match="SO2_1_Rn_1__1 has no compiled act"):
        _ = functions_of(Product(a=SO2, b=Rn(1))).act  # type: ignore[union-attr]


@pytest.mark.parametrize("group", [Product(a=SO2, b=Rn(1)), Product(a=Rn(1), b=SO2)])
def test_products_of_the_same_parts_in_another_order_are_not_confused(group: Any) -> None:
    """They have callees of the same names, which is what the cache on disk goes by."""
    functions, out = functions_of(group), np.empty(2)
    assert functions is not None
    functions.retract(np.array([3.0, 3.0]), np.array([1.0, 1.0]), out)
    np.testing.assert_array_equal(out, group.retract([3.0, 3.0], [1.0, 1.0]))


# -- batches --


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (SE2.exp, (np.zeros((5, 4)),), r"se2.exp takes \(..., 3\) arrays; got shape \(5, 4\)"),
        (SE3.retract, (SE3.identity(), np.zeros(3)), r"se3.retract takes \(..., 6\) arrays; got shape \(3,\)"),
        (SO2.exp, (0.3,), r"so2.exp takes \(..., 1\) arrays; got shape \(\)"),
        (SE2.compose, (np.zeros((2, 3)), np.zeros((4, 3))), "broadcast"),
    ],
)
def test_wrong_lengths_are_named(function: Callable[..., Array], arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError if message == "broadcast" else UnifgError, match=message):
        function(*arguments)


def test_any_layout_will_do(rng: Generator) -> None:
    x, y = SE3.random(rng, (4, 6)), SE3.random(rng, (4, 6))
    expected = SE3.compose(x, y)
    wide = rng.standard_normal((4, 6, 20))
    wide[..., 3:17:2] = x
    frozen = y.copy()
    frozen.flags.writeable = False
    layouts: list[Callable[[Array], Array]] = [np.asfortranarray, lambda a: a.astype(">f8"), lambda a: a[::-1][::-1]]
    for layout in layouts:
        np.testing.assert_array_equal(SE3.compose(layout(x), layout(y)), expected)
    np.testing.assert_array_equal(SE3.compose(wide[..., 3:17:2], frozen), expected)
    np.testing.assert_array_equal(SE3.compose(x.tolist(), y.tolist()), expected)
    assert SE2.compose([1, 2, 0], [3, 4, 0]).dtype == np.float64
    np.testing.assert_array_equal(SE2.compose([1, 2, 0], [3, 4, 0]), [4, 6, 0])


def test_a_group_of_your_own(rng: Generator) -> None:
    """The helpers take any compiled function of the right form."""
    double = over_one(rn.negate, 2, 2)
    plus = over_two(rn.add, 2, 2, 2)
    x, y = rng.standard_normal((3, 1, 2)), rng.standard_normal((5, 2))
    np.testing.assert_array_equal(double(x), -x)
    np.testing.assert_array_equal(plus(x, y), x + y)


# -- functions of an angle --


def bernoulli(count: int) -> list[Fraction]:
    numbers = [Fraction(1)]
    for n in range(1, count):
        numbers.append(-sum((comb(n + 1, k) * numbers[k] for k in range(n)), Fraction(0)) / (n + 1))
    return numbers


TERMS = 40
B = [Fraction((-1) ** n, factorial(2 * n + 2)) for n in range(TERMS)]
C = [Fraction((-1) ** n, factorial(2 * n + 3)) for n in range(TERMS)]
K = [abs(number) / factorial(2 * n + 2) for n, number in enumerate(bernoulli(2 * TERMS + 2)[2::2])]


def slope(series_of_t: list[Fraction]) -> list[Fraction]:
    """Twice the derivative with respect to t: that with respect to theta, over theta."""
    return [2 * n * a for n, a in enumerate(series_of_t)][1:]


def total(series_of_t: list[Fraction], t: Fraction) -> float:
    return float(sum(a * t**n for n, a in enumerate(series_of_t)))


@pytest.mark.parametrize(
    "theta", [0.0, 1e-300, 1e-160, 1e-12, 1e-4, 0.1, 0.49, 0.4999999, 0.5, 0.51, 0.7, 1.0, 2.0, 3.0]
)
@pytest.mark.product(6)
def test_functions_of_an_angle(theta: float) -> None:
    """Against exact sums of the power series; the slopes are multiplied by theta^3 at least wherever they serve."""
    square, t = Fraction(theta) ** 2, theta * theta
    half, a = series.sinc(theta / 2), series.sinc(theta)
    b, c, g = 0.5 * half * half, series.c_value(theta, np.sin(theta)), series.x_cot_x(theta / 2)
    values = [(b, B), (c, C), (series.k_value(t, g), K)]
    for value, exact in values:
        assert value == pytest.approx(total(exact, square), rel=1e-14, abs=0.0)
    slopes = [(series.b_slope(t, a, b), B), (series.c_slope(t, b, c), C), (series.k_slope(t, g), K)]
    weight = 1.0 if t < series.SERIES_BELOW else theta**3
    for value, exact in slopes:
        desired = total(slope(exact), square)
        assert abs(value - desired) * weight < 1e-15
        if t < series.SERIES_BELOW:
            assert value == pytest.approx(desired, rel=1e-15, abs=0.0)


def test_halves(rng: Generator) -> None:
    for x in [0.0, 1e-300, -1e-8, *rng.uniform(-PI, PI, 20)]:
        scale, cosine = series.sinc_and_cos(x)
        assert scale == series.sinc(x) == pytest.approx(np.sinc(x / PI), rel=1e-14)
        assert cosine == pytest.approx(np.cos(x), rel=0, abs=2e-16)
