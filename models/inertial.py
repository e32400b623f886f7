"""Gyro and accelerometer as factors between states that have a position, a velocity and an orientation.

With x = (p, v, R) and y the states of two nodes, Y what was preintegrated between them at the biases b0
(:mod:`unifg.models.preintegration`), and B its derivative by them, the residual is what is left of the motion, in the
tangent of SE_2(3):

    Log((Y Exp(B (b - b0)))^-1 M),    M = (R'(p_y - p - h v - h^2 g / 2), R'(v_y - v - h g), R' R_y)

(Forster et al. 2017, section VI-D, with one logarithm for all nine rows as in Brossard et al. 2021). Units of the rows
are m, m/s and rad. Biases are held over an interval; from one to the next they walk.

Where turns between nodes are known by other means, one mean force for each interval is a factor by itself
(:func:`specific_force`).
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np

from unifg.errors import ModelError, require_kinds, require_positive
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.residuals import Residual, residual
from unifg.lie import SE23, SO3, Manifold, Product
from unifg.locks import ReentrantLock
from unifg.modeling.duplicates import doubles
from unifg.modeling.factors import difference
from unifg.modeling.model import Model
from unifg.modeling.variables import Data, Selection, Variable, as_selection
from unifg.models.preintegration import BIAS, CLOSE, GRAVITY, ImuNoise, Preintegrated, down, preintegrate
from unifg.models.rigid import motion_parts
from unifg.models.stamped import Present, by_handle, state_whole
from unifg.typing import Array, ArrayLike

__all__ = ["InertialMeasurements", "motion", "specific_force"]

STILL = 1e-6  # standard deviation of each row, and of biases, over a step of no duration


def motion(state: Manifold = SE23, gravity: tuple[float, float, float] = GRAVITY) -> Residual:
    """``motion()(x, y, bias, increment, by_bias, reference, duration)``: (n, 9) [m, m/s, rad].

    ``graph.minimize(motion(), x[:-1], x[1:], bias[:-1], *measured[:4], information=measured.information)`` with
    ``measured`` from :func:`~unifg.models.preintegration.preintegrate`.

    Args:
        state: of x and y: SE23, or a product with components p and v in Rn(3) and R in SO3, as a quadrotor's.
        gravity: in the world [m/s^2].

    Raises:
        ModelError: for another manifold.
    """
    takes = ("in W_T_B", "in W_T_B", "in B", None, None, "in B", "s")
    return residual(_kernel(cast(Hashable, state), down(gravity)), takes=takes)


@cache
def _kernel(manifold: Hashable, gravity: tuple[float, ...]) -> StatedKernel:
    state = cast(Manifold, manifold)
    p, v, R = motion_parts(state, "inertial motion")

    def inertial(
        x: Array, y: Array, bias: Array, increment: Array, by_bias: Array, reference: Array, duration: Array
    ) -> Array:
        h, back = np.reshape(duration, (-1, 1)), SO3.inverse(x[:, R])
        fallen = h * np.array([gravity])
        moved = (y[:, p] - x[:, p]) - h * (x[:, v] + 0.5 * fallen)  # places differ before anything small is taken off
        sped = (y[:, v] - x[:, v]) - fallen
        seen = [SO3.act(back, moved), SO3.act(back, sped), SO3.compose(back, y[:, R])]
        shift = np.einsum("nij,nj->ni", by_bias, bias - reference)
        left = SE23.between(increment, np.concatenate(seen, axis=1))
        return SE23.log(SE23.compose(SE23.exp(-shift), left))

    shapes = (state, state, BIAS, (10,), (9, 6), (6,), ())
    return StatedKernel(inertial, shapes, 9, name="inertial motion")


def specific_force(state: Manifold = SE23, gravity: tuple[float, float, float] = GRAVITY) -> Residual:
    """``specific_force()(x, y, force, per_second)``: (n, 3) [m/s^2], in the world.

    (v_y - v_x) / h - g - (R_x f + R_y f) / 2 with force f (3,), the mean of what an accelerometer felt in its axes over
    the h seconds between x and y, and ``per_second`` 1/h. The mean turn is off by a twelfth of the square of the angle
    between the nodes. Noise of the sensor that is alike in all axes is so in the world.

    Args:
        state: as of :func:`motion`.
        gravity: in the world [m/s^2].

    Raises:
        ModelError: for another manifold.
    """
    takes = ("in W_T_B", "in W_T_B", "m/s^2 in B", "1/s")
    return residual(_felt(cast(Hashable, state), down(gravity)), takes=takes)


@cache
def _felt(manifold: Hashable, gravity: tuple[float, ...]) -> StatedKernel:
    state = cast(Manifold, manifold)
    _, v, R = motion_parts(state, "specific force")

    def felt(x: Array, y: Array, force: Array, per_second: Array) -> Array:
        pushed = 0.5 * (SO3.act(x[:, R], force) + SO3.act(y[:, R], force))
        left: Array = np.reshape(per_second, (-1, 1)) * (y[:, v] - x[:, v]) - np.array([gravity]) - pushed
        return left

    return StatedKernel(felt, (state, state, (3,), ()), 3, name="specific force")


@dataclass(frozen=True)
class SampleCounts:
    """Counts of samples by outcome.

    Attributes:
        kept: when data were asked for last.
        invalid: left out, because a number was not finite.
        repeated: left out, because there was a sample with that stamp.
        unknown: intervals of the last data without information: they begin before the first sample, or have a gap.
    """

    kept: int = 0
    invalid: int = 0
    repeated: int = 0
    unknown: int = 0


class InertialMeasurements:
    """Samples of one gyro and accelerometer, as factors between all neighbours of a trajectory.

    ``add`` takes samples as they arrive. As a term of a window (:class:`unifg.horizon.Window`) it is asked for the
    rest; in a graph by hand, ``state`` adds the factors once and ``at`` integrates what lies between nodes at given
    times, at given biases: a window of some thousand samples in some milliseconds. Nothing is compiled or laid out
    again in between. The body is the sensor: its place and axes are those of the states. Samples before the oldest node
    are forgotten, so one sensor serves one window. Threads may add while others ask.

    Attributes:
        noise: of the sensor.
        gap: for how long a sample may be held [s]; an interval with a longer gap is inactive, and only its biases walk.
        counts: what has become of the samples.
    """

    def __init__(
        self,
        noise: ImuNoise,
        *,
        body: str | None = None,
        bias: str = "bias",
        gap: float = 0.1,
        gravity: tuple[float, float, float] = GRAVITY,
        name: str = "imu",
    ) -> None:
        """Describe the sensor.

        Args:
            noise: of the sensor.
            body: component of the states that moves, as :func:`motion` takes it; None for the whole state.
            bias: on ``preintegration.BIAS``: a component of the states, or the name of a family with a member for
                each node, or with one, which stays.
            gap: for how long a sample may be held [s].
            gravity: in the world [m/s^2].
            name: of the terms.

        Raises:
            ModelError: when the gap is not positive, or an argument of another kind.
        """
        require_kinds(f"'{name}'", ModelError, type(self).__init__.__annotations__, locals(), ImuNoise, str)
        require_positive(f"'{name}'", ModelError, gap=gap)
        self.noise, self.gap, self.name = noise, gap, name
        self._body, self._bias, self._gravity = body, bias, gravity
        self._walk = f"{name}: walk"
        self._place: slice | None = None  # of biases in states
        self._lock = ReentrantLock()
        self.reset()

    def reset(self) -> None:
        """Forget all samples, and what has become of them."""
        with self._lock:
            self._samples: Array = np.empty((0, 7))  # stamp, rates, forces
            self._left = -np.inf  # the last stamp that has left
            self.counts = SampleCounts()

    def state(self, graph: Model, x: Variable, u: Any = None) -> None:
        """Add factors between all neighbours of x, and of the biases where there is one for each node.

        Raises:
            ModelError: when there are fewer than two nodes, the biases do not fit, or they are to walk without noise.
            GraphError: as the graph raises it. Either way the graph is as it was.
        """
        nodes = as_selection(x)
        body = nodes if self._body is None else getattr(nodes, self._body)
        biases = as_selection(self._biases(graph, nodes))
        if len(nodes) < 2 or len(biases) not in (1, len(nodes)) or biases.manifold != BIAS:
            raise ModelError(
                f"'{self.name}' needs two nodes or more and a bias on {BIAS.name}, for each or for all; found "
                f"{len(nodes)} and {len(biases)} on {biases.manifold.name}"
            )
        n = len(nodes) - 1
        nothing = preintegrate([], np.empty((0, 3)), np.empty((0, 3)), np.arange(n + 1.0), self.noise, np.zeros(6))
        walking = len(biases) > 1
        if walking and not min(self.noise.gyro_walk, self.noise.accelerometer_walk) > 0.0:
            walks = f"gyro_walk {self.noise.gyro_walk!r} and accelerometer_walk {self.noise.accelerometer_walk!r}"
            raise ModelError(
                f"'{self.name}': biases for each node walk by {walks}, which must be positive; one bias that stays is "
                "a family of one member"
            )
        moved = motion(body.manifold, self._gravity)

        def stated(graph: Model) -> None:
            data = {
                name: graph.data(name, value, each=True)
                for name, value in self._named(nothing).items()
                if walking or name != self._walk
            }
            *given, information, known = (handle for name, handle in data.items() if name != self._walk)
            graph.minimize(
                moved,
                *(body[:-1], body[1:], biases[:-1] if walking else biases, *given),
                information=information,
                active=known,
                name=self.name,
            )
            if walking:
                graph.minimize(difference, biases[:-1], biases[1:], sigma=data[self._walk], name=f"{self.name}: biases")

        state_whole(graph, stated)
        self._place = biases.storage if biases.family is nodes.family else None

    def _biases(self, graph: Model, nodes: Selection) -> Variable:
        if isinstance(nodes.manifold, Product) and self._bias in nodes.manifold.components:
            found: Selection = getattr(nodes, self._bias)
            return found
        if self._bias not in graph.families:
            raise ModelError(f"'{self.name}': neither {nodes.manifold.name} nor the graph has a '{self._bias}'")
        return graph.families[self._bias]

    def _named(self, found: Preintegrated) -> dict[str, Array]:
        """Values of the data, by name, in the order in which they are stated."""
        known = found.held <= self.gap + CLOSE
        return {
            f"{self.name}: increment": found.increment,
            f"{self.name}: by bias": found.by_bias,
            f"{self.name}: reference": found.bias,
            f"{self.name}: duration": found.duration,
            f"{self.name}: information": np.where(known[:, None, None], found.information, np.eye(9)),
            f"{self.name}: known": known,
            self._walk: self.noise.walk(found.duration),
        }

    def add(self, stamp: ArrayLike, gyro: ArrayLike, accelerometer: ArrayLike) -> None:
        """Take samples in any order: one stamp [s] with (3,) rates [rad/s] and forces [m/s^2], or (k,) with (k, 3).

        Raises:
            ModelError: on another shape.
            GraphError: on masked arrays, dates, and what is no real number.
        """
        parts = {"stamps": stamp, "rates": gyro, "forces": accelerometer}
        t, w, a = (doubles(f"'{self.name}': {what}", part) for what, part in parts.items())
        if t.ndim > 1 or w.shape != (*t.shape, 3) or a.shape != w.shape:
            raise ModelError(
                f"'{self.name}': stamps {t.shape} need rates and forces {(*t.shape, 3)}, found {w.shape}, {a.shape}"
            )
        rows = np.concatenate([t.reshape(-1, 1), w.reshape(-1, 3), a.reshape(-1, 3)], axis=1)
        good = np.isfinite(rows).all(axis=1)
        with self._lock:
            rows = np.concatenate([self._samples, rows[good]])
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            first = np.diff(rows[:, 0], prepend=-np.inf) > 0.0
            self._samples = rows[first]
            self.counts = replace(
                self.counts,
                invalid=self.counts.invalid + int((~good).sum()),
                repeated=self.counts.repeated + int((~first).sum()),
            )

    def data(self, now: Present) -> dict[str, Array]:
        """Values of the data, by name, for the nodes of a window; biases are those it believes in.

        Raises:
            ModelError: when samples between them have been forgotten for another window.
        """
        history = now.past
        times, first = np.array(history.times), int(history.empty)
        if self._place is not None:
            return self._given(times, first, history.states[:-1, self._place])
        found = self._given(times, first, now.constants[self._bias][0])
        del found[self._walk]  # there is one bias, which stays
        return found

    def at(self, graph: Model, times: ArrayLike, bias: ArrayLike) -> dict[Data, Array]:
        """Data of a graph for one solve, with nodes at these times; older samples are dropped.

        Args:
            graph: to which the factors have been added.
            times: (n,) of the nodes, increasing [s].
            bias: (6,) or (n - 1, 6), as they are believed to be.

        Raises:
            ModelError: when times or biases are not what they should be, or samples between them have been forgotten.
            GraphError: when the factors have not been added.
        """
        term: Any = graph.term(self.name)
        needed, at = term.count + 1, np.asarray(times, dtype=np.float64)
        if at.shape != (needed,) or not (np.isfinite(at).all() and (np.diff(at) > 0.0).all()):
            raise ModelError(f"'{self.name}': {needed} times are needed, finite and increasing, found {at}")
        walking = [f"{self.name}: biases"] if f"{self.name}: biases" in (term.name for term in graph.terms) else []
        return by_handle(graph, (self.name, *walking), self._given(at, 0, bias))

    def _given(self, times: Array, first: int, bias: ArrayLike) -> dict[str, Array]:
        """Values of the data, by name, for nodes of which those before the first are not there yet."""
        empty, first = first, int(np.searchsorted(times, times[first], side="right")) - 1
        times = np.concatenate([times[first] - np.arange(first, 0, -1.0), times[first:]])
        since = float(times[first])
        with self._lock:
            begin = float(self._samples[0, 0]) if len(self._samples) else np.inf
            if since < begin - CLOSE and self._left >= since - self.gap:
                raise ModelError(
                    f"'{self.name}': nodes from {since:.12g} s on are asked for, but the samples before {begin:.12g} s "
                    "have been forgotten: give every window a sensor of its own, and call reset() where time begins "
                    "anew"
                )
            old = int(np.searchsorted(self._samples[:, 0], since, side="right")) - 1
            if old > 0:
                self._left = max(self._left, float(self._samples[old - 1, 0]))
                self._samples = self._samples[old:]  # the one before the oldest node is held into its interval
            samples = self._samples
        found = self._integrated(samples, times, bias)
        found.held[:first] = np.inf
        unknown = int((found.held[first:] > self.gap + CLOSE).sum())
        with self._lock:
            self.counts = replace(self.counts, kept=len(samples), unknown=unknown)
        still = slice(empty, first)  # steps of no duration, in which nothing moves
        found.increment[still], found.by_bias[still], found.duration[still] = SE23.identity(), 0.0, 0.0
        found.covariance[still], found.held[still] = STILL**2 * np.eye(9), 0.0
        named = self._named(found)
        named[self._walk][still] = STILL
        return named

    def integrated(self, times: ArrayLike, bias: ArrayLike) -> Preintegrated:
        """The samples integrated between any times, as for a guess by :func:`unifg.models.preintegration.predict`."""
        return self._integrated(self._samples, times, bias)

    def _integrated(self, s: Array, times: ArrayLike, bias: ArrayLike) -> Preintegrated:
        return preintegrate(s[:, 0], s[:, 1:4], s[:, 4:], times, self.noise, bias)
