"""Gyro and accelerometer in the smoothers: two minutes of flight with biases that walk."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

import unifg as fg
from unifg.lie import SE23, SO3
from unifg.models.inertial import motion
from unifg.models.preintegration import BIAS, GRAVITY, ImuNoise, predict, preintegrate
from unifg.smoothing import FixedLag, Incremental
from unifg.typing import Array

NOISE = ImuNoise(gyro=1e-3, accelerometer=1e-2, gyro_walk=1e-3, accelerometer_walk=1e-2)
RATE, STEP, END, FIX = 100.0, 0.5, 120.0, 0.05


class Flight(NamedTuple):
    """True states of a flight, and measurements of its sensors.

    Attributes:
        times: (n,) of the nodes [s].
        states: (n, 10) there.
        biases: (n, 6) there.
        stamps: (m,) of the samples [s].
        gyro, accelerometer: (m, 3).
        fixes: (n, 3) positions, measured.
    """

    times: Array
    states: Array
    biases: Array
    stamps: Array
    gyro: Array
    accelerometer: Array
    fixes: Array


def flight(rng: np.random.Generator) -> Flight:
    """Eights with the nose about; samples are held, so that the truth is known exactly."""
    stamps, times = np.arange(0.0, END, 1.0 / RATE), np.arange(0.0, END, STEP)
    t = stamps[:, None]
    rates = np.concatenate([0.3 * np.cos(0.5 * t), 0.25 * np.sin(0.4 * t), 0.4 * np.cos(0.3 * t)], axis=1)
    turn, turns = SO3.identity(), []
    for step in SO3.exp(rates / RATE):
        turns.append(turn)
        turn = SO3.compose(turn, step)
    pushed = np.concatenate([-2.0 * np.sin(0.5 * t), -1.5 * np.cos(0.8 * t), 0.4 * np.sin(0.6 * t)], axis=1)
    forces = SO3.act(SO3.inverse(np.array(turns)), pushed - np.array(GRAVITY))
    start = np.concatenate([[0.0, 0.0, 5.0], [4.0, 0.0, 0.0], SO3.identity()])
    states = predict(start, preintegrate(stamps, rates, forces, times, NOISE, np.zeros(6)))
    walk = np.sqrt(1.0 / RATE) * np.repeat([NOISE.gyro_walk, NOISE.accelerometer_walk], 3)
    first = np.array([0.02, -0.01, 0.015, 0.1, -0.15, 0.05])
    biases = first + np.cumsum(walk * rng.standard_normal((len(t), 6)), axis=0)
    white = np.sqrt(RATE) * np.repeat([NOISE.gyro, NOISE.accelerometer], 3) * rng.standard_normal((len(t), 6))
    seen = np.concatenate([rates, forces], axis=1) + biases + white
    at_nodes = biases[np.searchsorted(stamps, times - 1e-9)]
    fixes = states[:, :3] + FIX * rng.standard_normal((len(times), 3))
    return Flight(times, states, at_nodes, stamps, seen[:, :3], seen[:, 3:], fixes)


def fly(smoother: Any, flown: Flight) -> tuple[Array, Array, Array]:
    """Feed node after node; returns states and biases believed at each when it came, and (n, 6) sigmas of biases."""
    x, bias = smoother.variables("x", SE23), smoother.variables("bias", BIAS)
    fixed, moved = fg.residual(lambda x, z: x[:, :3] - z), motion()
    states, biases, sigmas = [], [], []
    for k, time in enumerate(flown.times):
        if k == 0:
            here, believed = flown.states[0], np.zeros(6)
            smoother.minimize(fg.prior, x[0], here, sigma=np.array([0.1] * 6 + [0.02] * 3))
            smoother.minimize(fg.prior, bias[0], believed, sigma=np.array([0.05] * 3 + [0.3] * 3))
        else:
            here, believed = smoother.estimate(x[-1])[0], smoother.estimate(bias[-1])[0]
            first, last = np.searchsorted(flown.stamps, [flown.times[k - 1] - 1e-9, time - 1e-9])
            stamps, gyro, force = (log[first:last] for log in (flown.stamps, flown.gyro, flown.accelerometer))
            found = preintegrate(stamps, gyro, force, flown.times[k - 1 : k + 1], NOISE, believed)
            smoother.minimize(moved, x[k - 1], x[k], bias[k - 1], *found[:4], information=found.information)
            smoother.minimize(fg.between, bias[k - 1], bias[k], np.zeros(6), sigma=NOISE.walk(STEP)[0])
            here = predict(here, found)[-1]
        smoother.minimize(fixed, x[k], flown.fixes[k], sigma=FIX)
        smoother.update({x: here, bias: believed})
        states.append(smoother.estimate(x[k])[0])
        biases.append(smoother.estimate(bias[k])[0])
        sigmas.append(np.sqrt(np.diag(smoother.covariance(bias[k]))))
    return np.array(states), np.array(biases), np.array(sigmas)


@pytest.mark.product(1, of="studies")
@pytest.mark.parametrize("smoother", [Incremental(), FixedLag(20)], ids=["all of it", "ten seconds"])
def test_biases_that_walk_are_followed(smoother: Any) -> None:
    flown = flight(np.random.default_rng(0))
    states, biases, sigmas = fly(smoother, flown)
    settled = slice(40, None)
    error = SE23.local(flown.states, states)[settled]
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.8 * FIX
    assert np.sqrt(np.mean(error[:, 3:6] ** 2)) < 0.08
    assert np.sqrt(np.mean(error[:, 6:] ** 2)) < 0.01
    off = ((biases - flown.biases) / sigmas)[settled]
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.4  # as sure as it should be
    walked, left = flown.biases[-1] - flown.biases[0], biases[-1] - flown.biases[-1]
    for own in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(left[own]) < 0.5 * np.linalg.norm(walked[own])
