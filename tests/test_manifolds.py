"""Manifolds as values, exact wrapping of angles, products by name, and a manifold of the user's own."""

from __future__ import annotations

import copy
import pickle
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import Generator

from groups import BATCHES, CASES, PI, Case
from own_manifolds import Sphere
from unifg.errors import UnifgError
from unifg.lie import SE2, SE3, SO2, SO3, LieGroup, Manifold, Product, Rn, check_manifold, wrap_angle
from unifg.lie.product import ProductGroup

# -- wrapping --

TURN = Fraction(2 * PI)


@given(st.one_of(st.floats(-1e6, 1e6), st.floats(allow_nan=False, allow_infinity=False)))
def test_wrap_angle_is_exact(theta: float) -> None:
    wrapped = float(wrap_angle(theta))
    assert -PI <= wrapped < PI
    assert ((Fraction(theta) - Fraction(wrapped)) / TURN).denominator == 1  # whole turns, to the last bit
    assert float(wrap_angle(wrapped)) == wrapped


def test_wrap_angle_at_the_ends() -> None:
    below, above = float(np.nextafter(PI, 0)), float(np.nextafter(PI, 4))
    ends = np.array([PI, -PI, below, -below, above, -above, 3 * PI, -3 * PI, 2 * PI, 0.0, 1e-300, 5e-324])
    wrapped = wrap_angle(ends)
    assert np.all((wrapped >= -PI) & (wrapped < PI))
    np.testing.assert_array_equal(wrapped[[0, 1, 2, 3]], [-PI, -PI, below, -below])
    np.testing.assert_array_equal(wrapped[[4, 5]], [-below, below])
    np.testing.assert_array_equal(wrapped[8:], [0.0, 0.0, 1e-300, 5e-324])
    assert wrap_angle(np.zeros((2, 0, 3))).shape == (2, 0, 3)
    assert np.isnan(wrap_angle([np.inf, -np.inf, np.nan])).all()


# -- values: equality, hashing, pickling --


@pytest.mark.parametrize("case", list(CASES.values()), ids=list(CASES))
def test_manifolds_are_values(case: Case) -> None:
    group = case.group
    again = pickle.loads(pickle.dumps(group))
    assert again == group
    assert hash(again) == hash(group)
    assert copy.deepcopy(group) == group
    assert repr(group) == group.name
    assert isinstance(group, Manifold)
    assert [other.group == group for other in CASES.values()].count(True) == 1
    assert group != "SE2"


@pytest.mark.parametrize("group", [SE2, SO2, SE3, SO3])
def test_singletons_survive_pickling(group: Any) -> None:
    assert pickle.loads(pickle.dumps(group)) is group
    assert copy.copy(group) is group


def test_equal_arguments_make_equal_manifolds() -> None:
    assert Rn(2) == Rn(2) != Rn(3)
    assert len({Rn(2), Rn(2), Rn(3), SE2, SO2, SE3, SO3}) == 6
    assert Product(p=Rn(2), R=SO2) == Product(p=Rn(2), R=SO2)
    assert hash(Product(p=Rn(2), R=SO2)) == hash(Product(p=Rn(2), R=SO2))
    assert Product(p=Rn(2), R=SO2) != Product(R=SO2, p=Rn(2))  # another storage order
    assert Product(p=Rn(2), R=SO2) != Product(q=Rn(2), R=SO2)
    assert Rn(np.int64(2)) == Rn(2)


# -- products --


def test_components_have_their_places() -> None:
    state = Product(pose=SE2, motion=Product(v=Rn(2), bias=Rn(1)), heading=SO2)
    assert (state.storage, state.dim) == (7, 7)
    assert list(state.components) == ["pose", "motion", "heading"]
    motion = state.component("motion")
    assert motion.manifold == Product(v=Rn(2), bias=Rn(1))
    assert (motion.storage, motion.tangent) == (slice(3, 6), slice(3, 6))
    assert state.name == "Product(pose=SE2, motion=Product(v=Rn(2), bias=Rn(1)), heading=SO2)"
    with pytest.raises(UnifgError, match="no component 'speed': it has pose, motion, heading"):
        state.component("speed")


def test_product_is_componentwise(rng: Generator) -> None:
    state = Product(p=Rn(2), T=SE2)
    x, d = state.random(rng, (6,)), rng.standard_normal((6, 5))
    expected = np.concatenate([x[:, :2] + d[:, :2], SE2.retract(x[:, 2:], d[:, 2:])], axis=1)
    np.testing.assert_array_equal(state.retract(x, d), expected)
    # The translation of a product does not turn with its rotation: it is no SE2.
    loose = Product(p=Rn(2), R=SO2).retract([0, 0, PI / 2], [1, 0, 0])
    np.testing.assert_array_equal(loose, [1, 0, PI / 2])


def test_numbers_of_another_length_are_refused(rng: Generator) -> None:
    """A step of seven numbers would move x by its first six, and spread the seventh over the three of v."""
    product = Product(p=Rn(3), R=SO3, v=Rn(3))
    x, d = product.random(rng, (4,)), np.zeros((4, 9))
    for call, said in (
        (lambda: product.retract(x, d[:, :7]), r"\(\.\.\., 9\) arrays, for its dim; got shape \(4, 7\)"),
        (lambda: product.retract(x, x), r"got shape \(4, 10\)"),
        (lambda: product.local(x, d), r"\(\.\.\., 10\) arrays, for its storage; got shape \(4, 9\)"),
        (lambda: product.log(d), "its storage; got"),
        (lambda: product.exp(x), "its dim; got"),
        (lambda: product.compose(x, 1.0), r"got shape \(\)"),
        (lambda: product.unpack(d), "its storage; got"),
    ):
        with pytest.raises(UnifgError, match=said):
            call()


def test_pack_and_unpack(rng: Generator) -> None:
    state = Product(p=Rn(2), T=SE2)
    pose = SE2.random(rng, (4,))
    x = state.pack(p=[1.0, 2.0], T=pose)
    assert x.shape == (4, 5)
    np.testing.assert_array_equal(state.unpack(x)["T"], pose)
    np.testing.assert_array_equal(state.unpack(x)["p"], np.tile([1.0, 2.0], (4, 1)))
    with pytest.raises(UnifgError, match="packs p, T; got p"):
        state.pack(p=[1.0, 2.0])
    with pytest.raises(UnifgError, match=r"'T' of .* stores 3 numbers; got shape \(4, 2\)"):
        state.pack(p=[1.0, 2.0], T=pose[:, :2])


def test_a_dimension_is_a_whole_number() -> None:
    with pytest.raises(TypeError):
        Rn(2.5)  # type: ignore[arg-type]


# -- a manifold of the user's own --


MIXED: dict[str, Manifold] = {
    "alone": Sphere(),
    "with groups": Product(T=SE2, normal=Sphere(), scale=Rn(1)),
    "nested": Product(a=Product(normal=Sphere(), R=SO2), b=Sphere(), p=Rn(2)),
}


@pytest.mark.parametrize("manifold", list(MIXED.values()), ids=list(MIXED))
def test_storage_may_differ_from_dimension(manifold: Manifold, rng: Generator) -> None:
    assert isinstance(manifold, Manifold)
    assert manifold.storage > manifold.dim
    report = check_manifold(manifold)
    assert report.ok, str(report)
    for batch in BATCHES:
        x, d = manifold.random(rng, batch), rng.standard_normal((*batch, manifold.dim))
        assert manifold.retract(x, d).shape == x.shape == (*batch, manifold.storage)
        assert manifold.local(x, x).shape == d.shape
        assert not x.size or not np.all(manifold.is_valid(2.0 * x + 1.0))


def test_product_with_a_manifold_has_no_group_operations() -> None:
    mixed = Product(T=SE2, normal=Sphere())
    assert (mixed.storage, mixed.dim) == (6, 5)
    assert mixed.component("normal").storage == slice(3, 6)
    assert mixed.component("normal").tangent == slice(3, 5)
    assert not isinstance(mixed, LieGroup)
    for operation in ("exp", "log", "compose", "inverse", "act", "adjoint", "right_jacobian"):
        assert not hasattr(mixed, operation)
    assert isinstance(Product(T=SE2, p=Rn(1)), ProductGroup)
    assert mixed == Product(T=SE2, normal=Sphere()) == pickle.loads(pickle.dumps(mixed))
    assert not isinstance(object(), Manifold)
