"""Universal dynamics: defects, noisy controls and the covariance of a step."""

from __future__ import annotations

import numpy as np
import pytest

from unifg.errors import ModelError
from unifg.models import quadrotor, universal

RNG = np.random.default_rng(5)


def test_steps_have_no_defect() -> None:
    x, u = quadrotor.STATE.random(RNG, (6,)), RNG.normal(size=(6, 6))
    after = universal.step(x, u, 0.1)
    assert np.abs(universal.dynamics(x, u, after, 0.1)).max() < 1e-12
    assert np.abs(universal.increments(x, u, after, 0.1)).max() < 1e-11
    assert np.abs(universal.consistency(x, after, 0.1)).max() < 1e-12
    held = universal.step(x, universal.hover(x), 0.1)
    np.testing.assert_allclose(held[:, 7:], x[:, 7:], atol=1e-12)
    np.testing.assert_allclose(held[:, :3], x[:, :3] + 0.1 * x[:, 7:], atol=1e-12)
    with pytest.raises(ModelError, match="found \\(10,\\)"):
        universal.hover(x[0])


def test_the_step_follows_the_field() -> None:
    x, u, h = quadrotor.STATE.random(RNG, (6,)), RNG.normal(size=(6, 6)), 1e-6
    moved = quadrotor.STATE.local(x, universal.step(x, u, h)) / h
    np.testing.assert_allclose(moved, universal.field(x, u), atol=1e-5)


def test_a_quadrotor_is_a_universal_vehicle() -> None:
    x, u = quadrotor.STATE.random(RNG, (6,)), RNG.normal(size=(6, 4))
    whole = np.concatenate([u[:, :3], np.zeros((6, 2)), u[:, 3:] / 1.3], axis=1)
    none = np.zeros((1, 1))
    theirs = quadrotor.field(x, u, np.zeros((1, 6)), np.array([[1.3]]), np.zeros((1, 3)), np.zeros((1, 2)), none)
    np.testing.assert_allclose(universal.field(x, whole), theirs, atol=1e-12)


def test_the_covariance_is_that_of_noisy_controls_and_has_rank_six() -> None:
    dt, sigma_a, sigma_omega = 0.1, 0.3, 0.05
    P = universal.covariance(dt, sigma_a, sigma_omega)
    eye = np.eye(3)
    np.testing.assert_allclose(P[:3, :3], dt**2 * 0.25 * dt**2 * sigma_a**2 * eye)
    np.testing.assert_allclose(P[:3, 6:], dt**2 * 0.5 * dt * sigma_a**2 * eye)
    np.testing.assert_allclose(P[3:6, 3:6], dt**2 * sigma_omega**2 * eye)
    np.testing.assert_allclose(P[6:, 6:], dt**2 * sigma_a**2 * eye)
    assert np.linalg.matrix_rank(P) == 6
    rng = np.random.default_rng(0)
    x, u = quadrotor.STATE.random(rng, (20000,)), rng.normal(size=(20000, 6))
    noise = rng.normal(size=(20000, 6)) * ([sigma_omega] * 3 + [sigma_a] * 3)
    defects = universal.dynamics(x, u, universal.step(x, u + noise, dt), dt)
    np.testing.assert_allclose(defects.T @ defects / len(defects), P, atol=0.05 * dt**2 * sigma_a**2)


def test_three_equalities_and_six_costs_weigh_what_the_covariance_says() -> None:
    """|r|^2 under the pseudo-inverse of eq. 11, wherever the equality holds."""
    dt, sigma_a, sigma_omega = 0.1, 0.3, 0.05
    x, u = quadrotor.STATE.random(RNG, (6,)), RNG.normal(size=(6, 6))
    after = universal.step(x, u + 0.1 * RNG.normal(size=(6, 6)), dt)
    r = universal.dynamics(x, u, after, dt)
    weighed = np.einsum("ni,ij,nj->n", r, np.linalg.pinv(universal.covariance(dt, sigma_a, sigma_omega)), r)
    ours = universal.increments(x, u, after, dt) / ([sigma_omega] * 3 + [sigma_a] * 3)
    np.testing.assert_allclose((ours**2).sum(axis=1), weighed, rtol=1e-9)
