"""The timed elastic band (Roesmann, Feiten, Woesch, Hoffmann, Bertram, ROBOTIK 2012), written as a graph of unifg.

Unknowns are poses and the time intervals between them; everything that is wanted is a soft cost, a weighed square of
what is too much: short intervals (eq. 13), speeds and accelerations within limits (eq. 7 to 10), one circle through two
neighbouring poses (eq. 11), distance from things (eq. 6). Between rounds of Levenberg-Marquardt the band is resized, so
that its intervals stay near one length, and things are looked for where the robot then would be. Weights, rounds and
margins of numbers are the defaults of ``teb_local_planner`` 0.9; the distance kept from things is the margin of the
model-predictive controller here, as the planner's of 0.5 m closes every door.

Differences from that package: an interval is the exponential of an unknown, so that it stays positive; of the sides on
which the band could pass something, only that of the route is tried, which is repaired beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.lie import wrap_angle
from unifg.models import obstacles
from unifg.models.distance_map import SmoothField
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.local_planner import PlannerContext, Situation
from unifg.scenarios.perception.tracks import nearest
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array

__all__ = ["Band", "BandSettings", "ElasticBand"]

FAR_OFF = 1e3  # [m]; where a disc waits that is not there


@dataclass(frozen=True)
class BandSettings:
    """Numbers of the planner.

    Attributes:
        interval: length that intervals are kept at, and by how much they may differ [s].
        poses: least and greatest number of poses.
        rounds, iterations: of resizing, and of the solver in each.
        slack: by how much speeds and accelerations are kept below their limits [m/s, rad/s, ...].
        backwards: greatest speed backwards [m/s].
        time: weight of the intervals [1/s^2].
        speed, turn: weights of speeds beyond their limits.
        acceleration, turn_acceleration: of accelerations beyond theirs.
        circle: of what the robot would have to slide sideways.
        forward: of driving backwards.
        near: of what is missing of the distance kept from things [1/m^2].
        inflation, inflated: a wider distance [m], and its weight.
        checked: poses of the band that must be free for it to be driven.
        reach: distance by which the end of the band may move between ticks before it is laid anew [m].
    """

    interval: tuple[float, float] = (0.3, 0.1)
    poses: tuple[int, int] = (3, 25)
    rounds: int = 4
    iterations: int = 5
    slack: float = 0.1
    backwards: float = 0.2
    time: float = 1.0
    speed: float = 2.0
    turn: float = 1.0
    acceleration: float = 1.0
    turn_acceleration: float = 1.0
    circle: float = 1000.0
    forward: float = 1.0
    near: float = 50.0
    inflation: float = 0.6
    inflated: float = 0.1
    checked: int = 5
    reach: float = 1.0


def velocities(x: Array, y: Array, log_time: Array) -> Array:
    """(n, 2) mean speed along the heading in between, and turning speed, from pose to pose (eq. 7)."""
    turn = wrap_angle(y[:, 2] - x[:, 2])
    middle = x[:, 2] + 0.5 * turn
    ahead = (y[:, 0] - x[:, 0]) * np.cos(middle) + (y[:, 1] - x[:, 1]) * np.sin(middle)
    return np.stack([ahead, turn], axis=1) / np.exp(log_time)


def beyond(values: Array, least: Array, most: Array) -> Array:
    """Excess of values over their limits."""
    return np.maximum(values - most, 0.0) + np.maximum(least - values, 0.0)


def too_fast(x: Array, y: Array, log_time: Array, least: Array, most: Array) -> Array:
    """Speeds beyond their limits (eq. 8)."""
    return beyond(velocities(x, y, log_time), least, most)


def too_hard(x: Array, y: Array, z: Array, first: Array, second: Array, most: Array) -> Array:
    """Accelerations beyond their limits between two intervals (eq. 9, 10)."""
    change = velocities(y, z, second) - velocities(x, y, first)
    return beyond(2.0 * change / (np.exp(first) + np.exp(second)), -most, most)


def hard_start(x: Array, y: Array, log_time: Array, applied: Array, most: Array) -> Array:
    """The same from the velocity that the robot has."""
    return beyond((velocities(x, y, log_time) - applied) / np.exp(log_time), -most, most)


def hard_end(x: Array, y: Array, log_time: Array, most: Array) -> Array:
    """The same to rest, in which a band ends."""
    return beyond(-velocities(x, y, log_time) / np.exp(log_time), -most, most)


def sideways(x: Array, y: Array) -> Array:
    """(n, 1) by how far two poses are not on one circle (eq. 11) [m]."""
    along, across = np.cos(x[:, 2]) + np.cos(y[:, 2]), np.sin(x[:, 2]) + np.sin(y[:, 2])
    return (along * (y[:, 1] - x[:, 1]) - across * (y[:, 0] - x[:, 0]))[:, None]


def reversing(x: Array, y: Array) -> Array:
    """(n, 1) way made backwards [m]."""
    ahead = (y[:, 0] - x[:, 0]) * np.cos(x[:, 2]) + (y[:, 1] - x[:, 1]) * np.sin(x[:, 2])
    return np.maximum(-ahead, 0.0)[:, None]


def duration(log_time: Array) -> Array:
    """(n, 1) intervals [s] (eq. 13)."""
    return np.exp(log_time)


class Band:
    """The graph of a band of so many intervals.

    Attributes:
        count: of the intervals.
    """

    def __init__(
        self,
        field: SmoothField,
        settings: ControllerSettings,
        own: BandSettings,
        count: int,
    ) -> None:
        """Build and prepare the graph."""
        self.count = count
        s, m = settings, settings.discs
        graph = fg.Graph()
        self._x = x = graph.variables("pose", fg.SE2, count + 1)
        self._t = t = graph.variables("log interval", fg.Rn(1), count)
        self._start, self._end = graph.data("start", np.zeros(3)), graph.data("end", np.zeros(3))
        self._applied = graph.data("applied", np.zeros(2))
        self._centre = graph.data("disc centres", np.full((count - 1, m, 2), FAR_OFF), each=True)
        self._radius = graph.data("disc radii", np.zeros(m))
        graph.fix(x[0], self._start)
        graph.fix(x[-1], self._end)
        most = np.array(s.limits)
        fastest, slowest = most - own.slack, np.array([-own.backwards, -most[1]]) + own.slack
        hardest = s.most / s.dt - own.slack

        pulls = np.array([own.acceleration, own.turn_acceleration]) ** -0.5
        drives = np.array([own.speed, own.turn]) ** -0.5
        graph.minimize(duration, t, sigma=own.time**-0.5, name="time")
        graph.minimize(too_fast, x[:-1], x[1:], t, slowest, fastest, sigma=drives, name="speed")
        graph.minimize(hard_start, x[0], x[1], t[0], self._applied, hardest, sigma=pulls, name="first acceleration")
        graph.minimize(hard_end, x[-2], x[-1], t[-1], hardest, sigma=pulls, name="last acceleration")
        graph.minimize(sideways, x[:-1], x[1:], sigma=own.circle**-0.5, name="circle")
        graph.minimize(reversing, x[:-1], x[1:], sigma=own.forward**-0.5, name="forward")
        graph.minimize(too_hard, x[:-2], x[1:-1], x[2:], t[:-1], t[1:], hardest, sigma=pulls, name="acceleration")
        walls, discs = obstacles.wall_distance(field), obstacles.disc_clearance
        for name, distance, weight in (("near", s.margin, own.near), ("inflation", own.inflation, own.inflated)):
            short = obstacles.shortfall(walls, s.robot_radius + distance + own.slack * (name == "near"))
            graph.minimize(short, x[1:-1], sigma=weight**-0.5, name=f"walls, {name}")
            short = obstacles.shortfall(discs, s.robot_radius + distance + own.slack * (name == "near"))
            graph.minimize(short, x[1:-1], self._centre, self._radius, sigma=weight**-0.5, name=f"discs, {name}")
        self._run = LevenbergMarquardt(max_iterations=own.iterations).prepare(graph)

    def solve(self, poses: Array, times: Array, now: Situation, slots: int) -> tuple[Array, Array, int]:
        """Move a band.

        Args:
            poses: (count + 1, 3), the ends of which stay.
            times: (count,) intervals [s].
            now: what the tick gave.
            slots: number of discs that there is room for.

        Returns:
            Poses, intervals, and iterations.
        """
        chosen = nearest(now.tracks, now.pose, slots)
        when = np.cumsum(times)[: self.count - 1, None, None]
        centres, radii = np.full((self.count - 1, slots, 2), FAR_OFF), np.zeros(slots)
        centres[:, : len(chosen)], radii[: len(chosen)] = chosen.centre + when * chosen.velocity, chosen.radius
        solution = self._run.solve(
            {self._x: poses, self._t: np.log(times)[:, None]},
            data={
                self._start: poses[0], self._end: poses[-1], self._applied: now.applied, self._centre: centres,
                self._radius: radii,
            },
        )  # fmt: skip
        return solution[self._x], np.exp(solution[self._t][:, 0]), solution.iterations


class ElasticBand:
    """Band along the reference.

    Attributes:
        settings: limits of the robot.
        numbers: of the planner.
        poses, times: the last band, (n + 1, 3) and (n,); empty without one.
        iterations: of the solver at the last tick.
    """

    def __init__(self, context: PlannerContext, numbers: BandSettings | None = None) -> None:
        """Prepare graphs for bands of every length; without ``numbers`` with the published ones."""
        self.settings, self.numbers = context.settings, numbers or BandSettings()
        self.iterations = 0
        field = SmoothField(context.distance_map)
        least, most = self.numbers.poses
        self._bands = {n: Band(field, self.settings, self.numbers, n) for n in range(least - 1, most)}
        self.forget()

    def forget(self) -> None:
        """Drop the band."""
        self.poses, self.times = np.zeros((0, 3)), np.zeros(0)

    def control(self, now: Situation) -> Array | None:
        """The beginning of the band, if it is free."""
        poses, times = self.begin(now)
        self.iterations = 0
        for _ in range(self.numbers.rounds):
            poses, times = self.resized(poses, times)
            poses, times, took = self._bands[len(times)].solve(poses, times, now, self.settings.discs)
            self.iterations += took
        if not (np.isfinite(poses).all() and np.isfinite(times).all() and self.free(now, poses, times)):
            self.forget()
            return None
        self.poses, self.times = poses, times
        speeds = velocities(poses[:-1], poses[1:], np.log(times)[:, None])
        counts = np.minimum(np.maximum(np.round(times / self.settings.dt), 1.0), self.settings.horizon).astype(int)
        return self.saturated(np.repeat(speeds, counts, axis=0))

    def saturated(self, speeds: Array) -> Array:
        """Speeds (K, 2) slowed together, so that the curvature stays, where one of them is beyond its limit."""
        own, most = self.numbers, np.array(self.settings.limits)
        limits = np.where(speeds[:, :1] < 0.0, [[own.backwards, most[1]]], most[None])
        share = np.minimum(1.0, (limits / np.maximum(np.abs(speeds), 1e-9)).min(axis=1))
        slowed: Array = speeds * share[:, None]
        return slowed

    def begin(self, now: Situation) -> tuple[Array, Array]:
        """The last band from where the robot is now to where the reference ends, or a new one along it."""
        end = now.reference[-1]
        if len(self.times) and np.hypot(*(self.poses[-1] - end)[:2]) < self.numbers.reach:
            poses, times = self.poses.copy(), self.times.copy()
            passed = np.hypot(*(poses[: min(10, len(poses) - 2), :2] - now.pose[:2]).T).argmin()
            poses, times = poses[passed:], times[passed:]
            poses[0], poses[-1] = now.pose, end
            if len(times) >= 2:
                return poses, times
        return self.laid(now)

    def laid(self, now: Situation) -> tuple[Array, Array]:
        """A band along the reference, at full speed."""
        s, arc = self.settings, now.along()
        kept = np.concatenate([[True], np.diff(arc) > 1e-6])
        way = now.reference[kept]
        step = max(1, round(self.numbers.interval[0] / s.dt))
        poses = np.concatenate([now.pose[None], way[step::step], now.reference[-1:]])
        if np.hypot(*(poses[-1] - poses[-2])[:2]) < 1e-3 and len(poses) > 2:
            poses = np.delete(poses, -2, axis=0)
        if len(poses) < 3:
            middle = 0.5 * (poses[0] + poses[-1])
            middle[2] = poses[0, 2] + 0.5 * wrap_angle(poses[-1, 2] - poses[0, 2])
            poses = np.stack([poses[0], middle, poses[-1]])
        moves = np.hypot(*np.diff(poses[:, :2], axis=0).T) / s.limits[0]
        turns = np.abs(wrap_angle(np.diff(poses[:, 2]))) / s.limits[1]
        return poses, np.maximum(np.maximum(moves, turns), s.dt)

    def resized(self, poses: Array, times: Array) -> tuple[Array, Array]:
        """Split intervals that are too long, and join those that are too short."""
        (wanted, spare), (least, most) = self.numbers.interval, self.numbers.poses
        k = 0
        while k < len(times):
            if times[k] > wanted + spare and len(poses) < most:
                middle = 0.5 * (poses[k] + poses[k + 1])
                middle[2] = poses[k, 2] + 0.5 * wrap_angle(poses[k + 1, 2] - poses[k, 2])
                poses = np.insert(poses, k + 1, middle, axis=0)
                times = np.insert(times, k, 0.5 * times[k])
                times[k + 1] = times[k]
                k += 1 if times[k] <= wanted + spare else 0
            elif times[k] < wanted - spare and len(poses) > least:
                joined = k + 1 if k + 1 < len(times) else k - 1
                times[joined] += times[k]
                poses = np.delete(poses, max(k, joined), axis=0)
                times = np.delete(times, k)
                k += joined < k
            else:
                k += 1
        while len(poses) > most:  # a band that came longer than there are graphs
            poses, times = np.delete(poses, -2, axis=0), np.append(times[:-2], times[-2] + times[-1])
        return poses, times

    def free(self, now: Situation, poses: Array, times: Array) -> bool:
        """Return True if the first poses of a band, and what lies between them, are clear of everything."""
        count = min(self.numbers.checked, len(times))
        share = np.linspace(0.25, 1.0, 4)[:, None]
        places = poses[:count, None, :2] + share * (poses[1 : count + 1, None, :2] - poses[:count, None, :2])
        begins = np.concatenate([[0.0], np.cumsum(times)])[:count, None]
        when = begins + share[:, 0] * times[:count, None]
        return not now.hits(now.clearance(places, when), when).any()
