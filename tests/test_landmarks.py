"""Measurements of the quadrotor: bearings and ranges in the ground plane, height, and the vertical."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from unifg.models import landmarks
from unifg.models.quadrotor import STATE
from unifg.typing import Array

MARKS = np.array([[4.0, 1.0], [-2.0, 3.0], [1.0, -5.0], [6.0, 6.0]])


def state(position: tuple[float, float, float], roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    return STATE.pack(p=np.array(position), R=fg.SO3.from_rpy(roll, pitch, yaw), v=np.zeros(3))


def test_bearing_and_range_by_hand() -> None:
    seen = landmarks.observe(state((1.0, 2.0, 7.0)), [[2.0, 2.0], [1.0, 5.0], [-3.0, 2.0], [4.0, 6.0]])
    expected = [[0.0, 1.0], [np.pi / 2, 3.0], [-np.pi, 4.0], [np.arctan2(4.0, 3.0), 5.0]]  # pi is written -pi
    np.testing.assert_allclose(seen, expected, atol=1e-15)


def test_the_bearing_is_measured_from_the_heading() -> None:
    """Roll, pitch and height do not change what is seen; a turn about the vertical does."""
    level = landmarks.observe(state((1.0, 0.0, 2.0)), MARKS)
    banked = landmarks.observe(state((1.0, 0.0, 9.0), 0.7, -0.9, 0.0), MARKS)
    np.testing.assert_allclose(banked, level, atol=1e-14)
    turned = landmarks.observe(state((1.0, 0.0, 2.0), 0.7, -0.9, 0.4), MARKS)
    np.testing.assert_allclose(turned[:, 1], level[:, 1], atol=1e-14)
    np.testing.assert_allclose(fg.wrap_angle(turned[:, 0] - level[:, 0]), -0.4, atol=1e-14)


def test_bearings_are_wrapped() -> None:
    x, behind = state((0.0, 0.0, 1.0)), np.array([[-1.0, 0.01]])
    residual = landmarks.bearing_range(x, behind, np.array([-np.pi + 0.01, 1.0]))
    np.testing.assert_allclose(residual[0, 0], -0.02, atol=1e-5)


def test_nothing_to_see() -> None:
    assert landmarks.observe(state((0.0, 0.0, 1.0)), np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.0])
def test_the_vertical_tells_roll_and_pitch_but_no_heading(yaw: float) -> None:
    up = np.array([0.0, 0.0, 1.0])
    attitude = fg.SO3.from_rpy(0.2, -0.3, yaw)
    seen = landmarks.tilt(attitude, np.zeros(3))[0]
    np.testing.assert_allclose(seen, fg.SO3.to_matrix(attitude).T @ up, atol=1e-15)
    np.testing.assert_allclose(seen, landmarks.tilt(fg.SO3.from_rpy(0.2, -0.3, 0.0), np.zeros(3))[0], atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.5, np.pi])
def test_the_cost_of_a_tilt(angle: float) -> None:
    """1 - cos of the angle to the vertical: upside down is the worst and no second optimum."""
    residual = landmarks.tilt(fg.SO3.exp(angle * np.array([0.6, -0.8, 0.0])), np.array([0.0, 0.0, 1.0]))[0]
    assert 0.5 * residual @ residual == pytest.approx(1.0 - np.cos(angle), abs=1e-14)


def test_what_is_not_a_number_stays_so() -> None:
    x = state((0.0, 0.0, 1.0))
    x[0] = np.nan
    assert np.isnan(landmarks.observe(x, MARKS)).all()


def test_offsets_are_in_the_axes_of_the_pose() -> None:
    x, place, seen = np.array([[1.0, 2.0, np.pi / 2]]), np.array([[1.0, 5.0]]), np.array([[2.5, -0.5]])
    np.testing.assert_allclose(landmarks.offset(x, place, seen), [[0.5, 0.5]], atol=1e-12)
