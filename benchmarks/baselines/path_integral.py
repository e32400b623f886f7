"""Model-predictive path integral control (Williams et al., IEEE Transactions on Robotics 34 (2018), algorithm 1).

Noise is added to the last plan a thousand times, every drive is priced, and the new plan is their mean, weighed by
exp(-price / temperature). What it costs to leave the path, to be near things, and to be away from the goal are the
critics of ``nav2_mppi_controller`` (PathFollow, PathAlign, PathAngle, Obstacles, Goal, GoalAngle, PreferForward) with
its default weights, as are temperature, the weight of the noise itself, and the standard deviations; the horizon is
that of the model-predictive controller, which is 0.2 s longer. All noise comes from one seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.baselines.shared import rollouts, to_reference
from unifg.lie import wrap_angle
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.typing import Array

__all__ = ["PathIntegral", "PathIntegralSettings"]


@dataclass(frozen=True)
class PathIntegralSettings:
    """Numbers of the planner.

    Attributes:
        drives: samples.
        sigma: standard deviations of the noise [m/s, rad/s].
        temperature: lambda.
        gamma: weight of what a sample's noise costs.
        backwards: greatest speed backwards [m/s].
        every: only each such place of a drive is held against the path.
        follow: weight of the distance from the end of a drive to the end of the path ahead [1/m].
        align: weight of the mean distance to the path [1/m].
        occupied: share of the path ahead that must be blocked for drives not to be held against it.
        angle: weight of the angle between the end's heading and the way to the end of the path, [1/rad], where it is
            beyond ``angle_beyond`` [rad].
        angle_beyond: see there.
        forward: weight of driving backwards [1/m].
        near: weight of the mean of what is missing of ``inflation`` to the hull [1/m].
        critical: weight of all that is missing of ``margin`` [1/m].
        hit: price of touching something.
        margin, inflation: distances from the hull [m].
        goal: weight of the mean distance to the goal, within ``goal_within`` [1/m].
        goal_angle: weight of the mean angle to it, within ``turn_within`` [1/rad].
        goal_within, turn_within: distances from the goal; within the latter the path counts no more [m].
    """

    drives: int = 1000
    sigma: tuple[float, float] = (0.2, 0.4)
    temperature: float = 0.3
    gamma: float = 0.015
    backwards: float = 0.35
    every: int = 4
    follow: float = 5.0
    align: float = 10.0
    occupied: float = 0.05
    angle: float = 2.0
    angle_beyond: float = 0.785
    forward: float = 5.0
    near: float = 1.5
    critical: float = 20.0
    hit: float = 1e5
    margin: float = 0.1
    inflation: float = 0.55
    goal: float = 5.0
    goal_angle: float = 3.0
    goal_within: float = 1.4
    turn_within: float = 0.5


class PathIntegral:
    """Weighted mean of noisy drives.

    Attributes:
        settings: limits of the robot.
        numbers: of the planner.
        mean: (N, 2) the last plan, shifted by a tick [m/s, rad/s].
        iterations: number of drives.
    """

    def __init__(self, context: PlannerContext, numbers: PathIntegralSettings | None = None) -> None:
        """Construct for a map; without ``numbers`` with the published ones; all noise comes from ``context.rng``."""
        self.settings, self._rng = context.settings, context.rng
        self.numbers = numbers or PathIntegralSettings()
        self.iterations = self.numbers.drives
        self.mean: Array = np.zeros((self.settings.horizon, 2))

    def control(self, now: Situation) -> Array | None:
        """The mean of the drives, unless all of them hit something."""
        own, s = self.numbers, self.settings
        noise = self._rng.standard_normal((own.drives, s.horizon, 2)) * own.sigma
        wanted = self.mean + noise
        wanted[..., 0] = np.maximum(wanted[..., 0], -own.backwards)
        controls = now.reachable(wanted)
        price = self.price(now, controls)
        # What the noise itself costs (the cross term of eq. 27), of what could be driven of it.
        price += own.gamma * (self.mean / np.square(own.sigma) * (controls - self.mean)).sum(axis=(1, 2))
        if price.min() >= own.hit:
            self.mean = np.zeros_like(self.mean)
            return None
        weight = np.exp(-(price - price.min()) / own.temperature)
        plan: Array = np.einsum("m,mki->ki", weight / weight.sum(), controls)
        self.mean = np.concatenate([plan[1:], plan[-1:]])
        return plan

    def price(self, now: Situation, controls: Array) -> Array:
        """(M,) price of drives under controls (M, N, 2)."""
        own, dt = self.numbers, self.settings.dt
        states = rollouts(now.pose, controls, dt)[:, 1:]
        count, horizon = controls.shape[:2]
        times = dt * np.arange(1.0, horizon + 1)
        clearance = now.clearance(states[..., :2], times)
        inside = clearance < own.margin
        price: Array = np.where(now.hits(clearance, times).any(axis=1), own.hit, 0.0)
        price += own.critical * np.where(inside, own.margin - clearance, 0.0).sum(axis=1)
        price += own.near * np.where(inside, 0.0, np.maximum(own.inflation - clearance, 0.0)).mean(axis=1)
        price += own.forward * dt * np.maximum(-controls[..., 0], 0.0).sum(axis=1)
        target, goal = now.reference[-1], now.goal
        left = np.inf if goal is None else float(np.hypot(*(goal - now.pose)[:2]))
        if left < own.goal_within:
            price += own.goal * np.hypot(*np.moveaxis(states[..., :2] - target[:2], 2, 0)).mean(axis=1)
        if left < own.turn_within:
            price += own.goal_angle * np.abs(wrap_angle(states[..., 2] - target[2])).mean(axis=1)
            return price
        end = states[:, -1]
        offset = target[:2] - end[:, :2]
        distance = np.hypot(*offset.T)
        price += own.follow * distance
        if (now.clearance(now.reference[:, :2], 0.0) < 0.0).mean() <= own.occupied:
            sparse = states[:, own.every - 1 :: own.every, :2]
            away, _ = to_reference(now, sparse.reshape(-1, 2))
            price += own.align * away.reshape(count, -1).mean(axis=1)
        way = target[:2] - now.pose[:2]
        if abs(float(wrap_angle(np.arctan2(way[1], way[0]) - now.pose[2]))) > own.angle_beyond:
            price += own.angle * np.abs(wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - end[:, 2]))
        return price

    def forget(self) -> None:
        """Drop the last plan."""
        self.mean = np.zeros_like(self.mean)
