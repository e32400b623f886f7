"""Fixed-lag smoothing: the past beyond a window becomes a prior on what it touched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from unifg.errors import GraphError, require_kinds, require_positive
from unifg.locks import synchronized
from unifg.modeling.variables import Selection, Variable, as_selection
from unifg.smoothing.factors import Staged
from unifg.smoothing.families import GrowingFamily
from unifg.smoothing.marginalize import marginalize
from unifg.smoothing.smoother import Effort, Smoother
from unifg.typing import Array, BoolArray, Numbers


class FixedLag(Smoother):
    """Gauss-Newton over the newest part of a growing graph; what leaves the window is marginalised.

    Variables are eliminated in the order of their age. The oldest are then leaves of the elimination tree, and the
    update matrix one of them passed to its parent is the marginal of all it knew, a linear factor at the points where
    it was linearised. Dropping a variable is to keep that matrix and forget the rest.

    Variables that a prior touches move on: the prior, a quadratic in the steps from the points where it was made, is
    rewritten for the new point (see :mod:`unifg.smoothing.priors`). With ``fixed_points`` their linearisation points
    stay where they are until they leave the window. That keeps directions nobody has measured, such as the heading of
    the whole map, free of information that only stems from linearising at two points (G. Huang, A. Mourikis,
    S. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 29 (2010)); but
    steps that grow large stay linear, and after poor first guesses Gauss-Newton may diverge.

    On linear problems the estimates of the window are those of the whole history, either way.

    Attributes:
        lag: members, or seconds.
        dropped: factors left out so far because a variable of theirs had left the window.
    """

    _chronological = True

    def __init__(
        self,
        lag: int | None = None,
        *,
        seconds: float | None = None,
        late: Literal["refuse", "drop"] = "refuse",
        relinearize: float = 0.1,
        every: int = 1,
        wildfire: float = 1e-4,
        fixed_points: bool = False,
    ) -> None:
        """Start without variables.

        Args:
            lag: the newest so many members of each family stay, counted from the longest family.
            seconds: instead of ``lag``: what is at most so much older than the newest stays; ``update`` takes the time.
            late: what to do with factors on members that have left: refuse them, or leave them out and count them.
            relinearize: a variable is relinearised when an entry of its step exceeds this, in the units of its tangent.
            every: linearisation points are looked at in every so many updates.
            wildfire: back-substitution stops where steps change by less, in the units of the tangent.
            fixed_points: never relinearise what a prior touches, so that its factors all stay linear at one point
                (first-estimates Jacobians); otherwise priors are rewritten for points that move.

        Raises:
            GraphError: when a number is out of range, or not exactly one of ``lag`` and ``seconds`` is given.
        """
        super().__init__(relinearize, every, wildfire)
        if (lag is None) == (seconds is None):
            raise GraphError("FixedLag: give either lag= (a number of members) or seconds=")
        require_kinds("FixedLag", GraphError, FixedLag.__init__.__annotations__, {"lag": lag, "seconds": seconds})
        self.lag = float(lag if lag is not None else seconds)  # type: ignore[arg-type]
        require_positive("FixedLag", GraphError, finite=False, **{"the lag": self.lag})
        if late not in ("refuse", "drop"):
            raise GraphError(f"FixedLag: late must be 'refuse' or 'drop', found {late!r}")
        self.dropped = 0
        self._timed = lag is None
        self._fixed = fixed_points
        self._drop = late == "drop"
        self._newest = -np.inf

    @synchronized
    def update(
        self,
        values: Mapping[GrowingFamily, Numbers] | None = None,
        *,
        time: float | None = None,
        iterations: int = 1,
    ) -> Effort:
        """Take in what was stated since the last update, improve all estimates, and drop what has become too old.

        Args:
            values: initial values of new members, (storage,) for one or (n, storage), appended to their families.
            time: of the new members [s], when the lag is in seconds.
            iterations: Gauss-Newton passes before anything is dropped.

        Returns:
            What the last pass did, and how many variables were dropped.

        Raises:
            GraphError: as :meth:`Incremental.update`; also for a factor on a member that has left, when they are
                refused, and for a ``time`` that is missing, superfluous, or older than the lag.
        """
        if values and self._timed != (time is not None):
            raise GraphError(
                "FixedLag: a lag in seconds needs time= with new members"
                if self._timed
                else "FixedLag: time= has no meaning for a lag that counts members"
            )
        if time is not None and not np.isfinite(time):
            raise GraphError(f"FixedLag: time must be finite, found {time}")
        if time is not None and time <= self._newest - self.lag and not self._drop:
            raise GraphError(
                f"FixedLag: time {time:g} is {self._newest - time:g} s before the newest, {self._newest:g}: such "
                f"members leave a lag of {self.lag:g} s at once; does time run backwards? late='drop' takes them"
            )
        self._update(values, time, iterations)
        leaving = marginalize(self._memory, self._newest - self.lag, 1 if self._fixed else 2)
        for v in leaving.tolist():
            family = self._order[int(self._state.variables["family"][v])]
            family.forget(int(self._state.variables["member"][v]))
        self._batches.forget(self._state)
        return self._effort()

    @synchronized
    def window(self, variable: Variable) -> Selection:
        """Those of the selected members that are still there."""
        selection = as_selection(variable)
        family = selection.family
        assert isinstance(family, GrowingFamily)
        kept = np.isin(selection.indices, family.alive())
        return Selection(family, selection.indices[kept], selection.component)

    def _stamps(self, family: GrowingFamily, count: int, time: float | None) -> Array:
        if family.keep:
            return np.full(count, np.inf)
        if time is not None:
            stamps = np.full(count, float(time))
        else:
            stamps = np.arange(family.count, family.count + count, dtype=np.float64)
        self._newest = max(self._newest, float(stamps[-1]))
        return stamps

    def _late(self, item: Staged, gone: BoolArray) -> None:
        if not self._drop:
            super()._late(item, gone)
        self.dropped += int(gone.sum())
        item.keep(~gone)
