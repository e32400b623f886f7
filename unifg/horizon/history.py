"""Controls, measurements and beliefs of the last nodes: numbers, no graph.

Nodes run from the oldest to the present one. While fewer than L steps have been made the oldest places are empty.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from unifg.errors import GraphError
from unifg.horizon.robot import Robot, numbers, require_steps
from unifg.lie import Manifold
from unifg.modeling.elements import nearest
from unifg.typing import Array, ArrayLike, BoolArray


class History:
    """The last L steps of a robot.

    Attributes:
        length: number L of steps.
        filled: whether no place is ever empty.
        entered: how many of them have been made.
        states: (L + 1, storage) believed, the present last.
        controls: (L, m) applied from each node to the next.
        times: (L + 1,) of the nodes [s].
        steps: (L, storage) believed unknowns of the steps, by name.
        constants: (count, storage) believed constants, by name.
        initial: (L + 1,) whether a node is the one everything began at.
        elements: manifolds of those measurements that terms take for elements of one, by name.
    """

    def __init__(
        self,
        robot: Robot,
        length: int,
        start: ArrayLike,
        records: Mapping[str, tuple[int, ...]],
        filled: bool = False,
    ) -> None:
        """Begin with the present alone.

        Args:
            robot: who moves.
            length: number of steps.
            start: (storage,) present state.
            records: shapes of what is measured at a node, by name.
            filled: whether steps of no duration have led to the present, so that no place is empty.

        Raises:
            GraphError: when there is no step, or the start is not on the robot's manifold.
        """
        require_steps("a window", "length", length)
        present = robot.point(start, "the start")
        self.length, self.filled, self.elements = length, filled, dict[str, Manifold]()
        self.states = np.tile(present, (length + 1, 1))
        self.controls = np.zeros((length, robot.control.storage))
        self.times = np.zeros(length + 1)
        self.steps = {name: np.tile(kind.identity(), (length, 1)) for name, kind in robot.steps.items()}
        self.constants = {static.name: static.values for static in robot.constants}
        self._resting = {name: kind.identity() for name, kind in robot.steps.items()}
        self._starting = dict(self.constants)
        self._values = {name: np.zeros((length + 1, *shape)) for name, shape in records.items()}
        self._measured = {name: np.zeros(length + 1, dtype=bool) for name in records}
        self.begin(present)

    def begin(self, start: Array) -> None:
        """Forget everything; the present is a state (storage,)."""
        self.entered = self.length if self.filled else 0
        self.states[:], self.controls[:], self.times[:] = start, 0.0, 0.0
        self.initial = np.arange(self.length + 1) == self.empty
        self.constants = {name: values.copy() for name, values in self._starting.items()}
        for name, array in self.steps.items():
            array[:] = self._resting[name]
        for measured in self._measured.values():
            measured[:] = False

    @property
    def full(self) -> bool:
        """True if the next step drops the oldest node."""
        return self.entered == self.length

    @property
    def empty(self) -> int:
        """Places that no node has entered yet; the index of the oldest node."""
        return self.length - self.entered

    @property
    def present(self) -> Array:
        """(storage,) believed present state."""
        state: Array = self.states[-1]
        return state

    def later(self, time: float | None, step: float = 1.0) -> float:
        """The time of a new node; None for a step [s] after that of the present one.

        Raises:
            GraphError: when time is not finite or runs backwards.
        """
        new = float(self.times[-1]) + step if time is None else instant(time)
        if not new > self.times[-1]:
            raise GraphError(f"the new node at {new} s is not later than the present one at {self.times[-1]} s")
        return new

    def move(self, control: ArrayLike, state: ArrayLike, time: float, steps: Mapping[str, ArrayLike]) -> None:
        """Let the present become the past.

        Args:
            control: (m,) applied since the last node.
            state: (storage,) where it should have led.
            time: of the new node [s].
            steps: (storage,) guesses of the new step's unknowns, by name; what is missing is guessed at the identity.

        Raises:
            GraphError: when time runs backwards.
        """
        time = self.later(time)
        self.entered = min(self.entered + 1, self.length)
        rows = (self.states, self.controls, self.times, self.initial, *self.steps.values())
        for array in (*rows, *self._values.values(), *self._measured.values()):
            array[:-1] = array[1:]
        self.states[-1], self.controls[-1], self.times[-1], self.initial[-1] = state, control, time, False
        for name, array in self.steps.items():
            array[-1] = steps.get(name, self._resting[name])
        for name, values in self._values.items():
            values[-1], self._measured[name][-1] = 0.0, False

    def record(self, name: str, value: ArrayLike, node: int = -1) -> None:
        """Attach a measurement to a node, the present one by default, an older one where it arrives late.

        A value with an entry that is not finite was not measured, also where one was recorded before.

        Raises:
            GraphError: when nothing measures that, its shape differs, or the node has not entered or has left.
        """
        array = self.readable(name, value)
        if not isinstance(node, int | np.integer):
            raise GraphError(f"measurement '{name}' of node {node!r}: a whole number is expected")
        place = node if node >= 0 else self.length + 1 + node
        if not self.empty <= place <= self.length:
            raise GraphError(f"measurement '{name}' of node {node}: the window holds nodes {self.empty}..{self.length}")
        measured = bool(np.isfinite(array).all())
        self._values[name][place], self._measured[name][place] = array if measured else 0.0, measured

    def readable(self, name: str, value: ArrayLike) -> Array:
        """A measured value as an array.

        Raises:
            GraphError: when nothing measures that, its shape differs, it holds no numbers, or is off its manifold.
        """
        if name not in self._values:
            raise GraphError(f"nothing measures '{name}' (there are: {', '.join(self._values) or 'none'})")
        what, kind = f"measurement '{name}'", self.elements.get(name)
        array = numbers(value, self._values[name].shape[1:], what, finite=False)
        return array if kind is None or not np.isfinite(array).all() else nearest(what, kind, array, None, name)

    def recorded(self, name: str) -> tuple[Array, BoolArray]:
        """(L + 1, ...) what was measured at the nodes, and (L + 1,) whether it was."""
        return self._values[name], self._measured[name]


def instant(time: float) -> float:
    """A time [s].

    Raises:
        GraphError: when it is none.
    """
    return float(numbers(time, (), "a time [s]"))
