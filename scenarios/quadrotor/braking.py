"""Coming to rest without a solver: level out against the motion, hold the height."""

from __future__ import annotations

import numpy as np

from unifg.lie import SO3
from unifg.models import quadrotor
from unifg.typing import Array

DECELERATION = 4.0  # [m/s^2] at most, horizontally
LIFT = 3.0  # [m/s^2] at most, vertically
VELOCITY_TIME = 0.4  # [s] in which a velocity is to fade
ATTITUDE_TIME = 0.12  # [s] in which an attitude is to be reached
DELAY = 0.2  # [s] until the vehicle leans against its motion


def braking_control(
    state: Array, parameters: quadrotor.Parameters, least: Array, most: Array, sink: float = 0.0
) -> Array:
    """The control (4,) between limits that slows a vehicle in a state (10,) down to hover, or to ``sink`` [m/s]."""
    rotation, velocity = state[3:7], state[7:10]
    wanted = -(velocity + np.array([0.0, 0.0, sink])) / VELOCITY_TIME
    flat = float(np.hypot(*wanted[:2]))
    wanted[:2] *= min(1.0, DECELERATION / max(flat, 1e-9))
    wanted[2] = np.clip(wanted[2], -LIFT, LIFT)
    lift = wanted + np.array([-parameters.wind[0], -parameters.wind[1], quadrotor.GRAVITY - parameters.updraft])
    lift += SO3.act(rotation, np.array(parameters.drag) * SO3.act(SO3.inverse(rotation), velocity)) / parameters.mass
    up = SO3.act(rotation, quadrotor.UP)
    thrust = parameters.mass * float(lift @ up)
    # The shortest turn of the body that brings its third axis along the lift.
    aim = SO3.act(SO3.inverse(rotation), lift / np.linalg.norm(lift))
    sine, cosine = float(np.hypot(aim[0], aim[1])), float(aim[2])
    angle = np.arctan2(sine, cosine)
    rates = angle / ATTITUDE_TIME * np.array([-aim[1], aim[0], 0.0]) / max(sine, 1e-9)
    control: Array = np.clip(np.append(rates, thrust), least, most)
    return control


def brake(
    state: Array, parameters: quadrotor.Parameters, count: int, dt: float, least: Array, most: Array
) -> tuple[Array, Array]:
    """Controls (N, 4) and states (N + 1, 10) of coming to rest from ``state`` in ``count`` steps of ``dt`` [s].

    ``least`` and ``most`` (4,) limit the controls [rad/s, N].
    """
    controls, states = np.zeros((count, 4)), np.tile(state, (count + 1, 1))
    for k in range(count):
        controls[k] = braking_control(states[k], parameters, least, most)
        states[k + 1] = quadrotor.step(states[k : k + 1], controls[k : k + 1], dt, parameters)[0]
    return controls, states


def stopping_path(position: Array, velocity: Array, times: Array) -> Array:
    """Positions (N, 2) [m] at times [s] of a vehicle that goes on for the delay and then brakes in the ground plane."""
    speed = float(np.hypot(*velocity[:2]))
    braked = np.clip(times - DELAY, 0.0, speed / DECELERATION)
    travelled = speed * (np.minimum(times, DELAY) + braked) - 0.5 * DECELERATION * braked**2
    return position[:2] + travelled[:, None] * velocity[:2] / max(speed, 1e-9)


def stopping_height(height: float, rate: float, times: Array) -> Array:
    """Height (N,) [m] at times [s] of a vehicle that stops climbing or sinking at ``rate`` [m/s], without delay."""
    braked = np.minimum(times, abs(rate) / LIFT)
    heights: Array = height + rate * braked - 0.5 * np.sign(rate) * LIFT * braked**2
    return heights
