"""Robot: manifolds of state and control, and constant unknowns shared by past and future."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from inspect import signature

import numpy as np

from unifg.errors import GraphError, require_kinds, require_positive
from unifg.lie import Manifold
from unifg.modeling.duplicates import doubles
from unifg.modeling.model import Model
from unifg.modeling.variables import Family
from unifg.typing import Array, ArrayLike, IntArray


@dataclass(frozen=True, eq=False)
class Constant:
    """Unknowns that do not change with time: parameters, landmarks, biases. One family in every graph of the robot.

    Attributes:
        name: of the family; terms find it as ``graph.families[name]``.
        manifold: of every member.
        start: (count, storage) believed at the start, or (storage,) for one member.
        sigma: standard deviations of that belief in the tangent space, of any shape that fits (count, dim); infinite
            where nothing is believed, which leaves it to the measurements alone; zero throughout for what is known,
            which is fixed to its start.

    Raises:
        GraphError: when the start does not lie on the manifold, or a standard deviation is not positive.
    """

    name: str
    manifold: Manifold
    start: ArrayLike
    sigma: ArrayLike

    def __post_init__(self) -> None:
        """Refuse what cannot be believed, and keep the rest, whatever the caller does with its arrays."""
        start = np.atleast_2d(doubles(f"static '{self.name}': its start", self.start)).copy()
        if start.ndim != 2 or start.shape[1] != self.manifold.storage or not np.all(self.manifold.is_valid(start)):
            raise GraphError(
                f"static '{self.name}': its start has shape {start.shape}, expected (count, {self.manifold.storage}), "
                f"or is not on {self.manifold.name}",
                family=self.name,
            )
        try:
            given = doubles(f"static '{self.name}': sigma", self.sigma)
            sigma = np.broadcast_to(given, (len(start), self.manifold.dim))
        except ValueError as error:
            raise GraphError(
                f"static '{self.name}': sigma does not fit ({len(start)}, {self.manifold.dim})", family=self.name
            ) from error
        if not np.all(sigma > 0.0) and np.any(sigma):
            raise GraphError(f"static '{self.name}': standard deviations must be positive", family=self.name)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "sigma", sigma.copy())

    @property
    def values(self) -> Array:
        """(count, storage) at the start."""
        return np.atleast_2d(np.array(self.start, dtype=np.float64))

    @property
    def information(self) -> Array:
        """(count, dim, dim) about the start."""
        return information_of(np.asarray(self.sigma, dtype=np.float64))

    @property
    def known(self) -> bool:
        """True if it is no unknown at all."""
        return not np.any(self.sigma)

    def family(self, graph: Model) -> Family:
        """Add the family to a graph; what is known is fixed."""
        family = graph.variables(self.name, self.manifold, len(self.values))
        if self.known:
            graph.fix(family, self.values, name=f"{self.name}, known")
        return family


@dataclass(frozen=True)
class Robot:
    """One trajectory family, the controls that drive it, and what else is unknown.

    Attributes:
        state: manifold of every node of the trajectory.
        control: manifold R^m of the controls.
        constants: unknowns that past and future share.
        steps: manifolds by name of unknowns that belong to each step of the past, as process noise; terms of the past
            find the families, one member per step, as ``graph.families[name]``.
        predict: ``predict(x, u)`` gives the state (storage,) after one step with a control (m,): the first guess of the
            next node, and the states that kept plans and braking lead to. None: it stays where it is.
        tick: length of a tick [s]; with it ``predict(x, u, seconds)`` is given the length of a step, as horizons with
            node times of any spacing need. None: all steps are of one length, which ``predict`` has.

    Raises:
        GraphError: for parts of another kind, a tick that is not positive, or where ``predict`` takes other arguments.
    """

    state: Manifold
    control: Manifold
    constants: tuple[Constant, ...] = ()
    steps: Mapping[str, Manifold] = field(default_factory=dict)
    predict: Callable[..., Array] | None = None
    tick: float | None = None

    def __post_init__(self) -> None:
        """Refuse a model that could not be called, and a tick that is none, before a loop needs them."""
        require_kinds("Robot", GraphError, Robot.__annotations__, vars(self))
        if not (isinstance(self.constants, tuple | list) and all(isinstance(one, Constant) for one in self.constants)):
            raise GraphError(f"the robot's constants are a tuple, as (Constant(...),), found {self.constants!r}")
        require_positive("Robot", GraphError, tick=1.0 if self.tick is None else self.tick)
        given = "x, u" if self.tick is None else "x, u, seconds"
        try:
            with suppress(ValueError):  # of a builtin that tells nothing about its arguments
                signature(self.predict or self.predicted).bind(*given.split(", "))
        except TypeError as error:
            raise GraphError(
                f"the robot's predict is called as predict({given}), with a tick as predict(x, u, seconds): {error}"
            ) from error

    def places(self, size: str) -> dict[str, IntArray]:
        """(count, k) places of the members of each constant among all of them, counted in "dim" or in "storage"."""
        at, found = 0, dict[str, IntArray]()
        for constant in self.constants:
            shape = len(constant.values), int(getattr(constant.manifold, size))
            found[constant.name] = at + np.arange(shape[0] * shape[1]).reshape(shape)
            at += shape[0] * shape[1]
        return found

    def predicted(self, state: Array, control: Array, seconds: float | None = None) -> Array:
        """(storage,) state after a step with a control (m,).

        Args:
            state: (storage,) before it.
            control: (m,) that acts.
            seconds: length of the step of a robot with a tick; None for a tick.

        Raises:
            GraphError: when ``predict`` gives something else.
        """
        if self.predict is None:
            return state.copy()
        length = () if self.tick is None else (self.tick if seconds is None else seconds,)
        found = doubles("the state that predict gives", self.predict(state, control, *length))
        if found.size != self.state.storage:
            raise GraphError(f"predict must give a state ({self.state.storage},), found {found.shape}")
        return found.reshape(self.state.storage)

    def applicable(self, control: ArrayLike) -> Array:
        """A control (m,) that was applied.

        Raises:
            GraphError: when it is none.
        """
        return numbers(control, (self.control.storage,), "the control that was applied")

    def point(self, state: ArrayLike, what: str) -> Array:
        """A point (storage,) of the robot's manifold.

        Raises:
            GraphError: when it is none.
        """
        point = numbers(state, (self.state.storage,), what).copy()
        if not np.all(self.state.is_valid(point)):
            raise GraphError(f"{what} {point} is not a point of {self.state.name}")
        return point

    def rollout(self, state: Array, controls: Array, lengths: Array | None = None) -> Array:
        """(k + 1, storage) states that controls (k, m) lead to, in steps of ``lengths`` (k,) [s]; None for ticks."""
        states = [np.asarray(state, dtype=np.float64)]
        for k, control in enumerate(controls):
            states.append(self.predicted(states[-1], control, None if lengths is None else float(lengths[k])))
        return np.array(states)

    def between(self, times: Array, states: Array, controls: Array, at: Array) -> tuple[Array, Array]:
        """States and controls of a plan on other nodes: along geodesics, and what acts after each node but the last.

        Args:
            times: (N + 1,) of the plan.
            states: (N + 1, storage).
            controls: (N, m), each held for a step.
            at: (M + 1,) times of the other nodes; beyond its end the plan rests.
        """
        at = np.minimum(at, times[-1])
        step = np.minimum(np.searchsorted(times, at + 1e-9 * times[1], side="right") - 1, len(controls) - 1)
        share = (at - times[step]) / np.diff(times)[step]
        ahead = self.state.retract(states[step], share[:, None] * self.state.local(states[step], states[step + 1]))
        return ahead, controls[step[:-1]]


def control_limits(limits: tuple[ArrayLike, ArrayLike], size: int) -> tuple[Array, Array]:
    """Least and greatest controls (m,), between which there are some."""
    try:
        least, most = (np.broadcast_to(np.array(limit, dtype=np.float64), (size,)) for limit in limits)
    except (TypeError, ValueError) as error:
        raise GraphError(
            f"the limits must be two, ({size},) each: least and greatest controls; got {limits}"
        ) from error
    if not (np.all(least <= most) and np.all(least < np.inf) and np.all(most > -np.inf)):
        raise GraphError(f"the limits leave no control: the least ({size},) is {least}, the greatest {most}")
    return least, most


def require_steps(what: str, name: str, count: object) -> None:
    """Refuse a number of steps that is not whole, or below one."""
    if not isinstance(count, int | np.integer) or count < 1:
        raise GraphError(f"{what} needs at least one step, a whole number of them; found {name}={count!r}")


def numbers(value: ArrayLike, shape: tuple[int, ...], what: str, *, finite: bool = True, family: str = "") -> Array:
    """An array of that shape.

    Raises:
        GraphError: when the value is none, is masked, or holds numbers that are not finite where they should be.
    """
    array = np.asarray(doubles(what, value, flags=True), dtype=np.float64)
    if array.shape != shape:
        raise GraphError(f"{what} has shape {array.shape}, expected {shape}", family=family)
    if finite and not np.isfinite(array).all():
        raise GraphError(f"{what} must be finite numbers, got {value!r}", family=family)
    return array


def information_of(sigma: Array) -> Array:
    """(..., d, d) diagonal information of standard deviations (..., d); none where they are infinite."""
    return np.eye(sigma.shape[-1]) / np.square(sigma)[..., None]
