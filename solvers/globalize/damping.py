"""Levenberg-Marquardt control of the damping by the gain ratio (Nielsen 1999)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unifg.typing import Array

SMALLEST = 1e-13  # DAMPED times this is HARDLY: what is said to be hardly determined has been found undamped
LARGEST = 1e12
SHRINK = 0.1
SUFFICIENT = 1e-4


@dataclass
class Damping:
    """Damping that grows after rejected steps and shrinks after good ones.

    Attributes:
        value: present damping, relative to the diagonal of the Hessian.
        growth: factor of the next rejection; doubles with each.
        share: of the second derivatives that left the last model convex.
        base: (M,) constraints where the step is zero, in the model of the step taken last.
    """

    value: float
    growth: float = 2.0
    share: float = 1.0
    base: Array = field(default_factory=lambda: np.zeros(0))

    def reject(self) -> None:
        """Grow, faster with every rejection in a row."""
        self.value = max(self.value, SMALLEST) * self.growth
        self.growth *= 2.0

    def accept(self, gain: float) -> None:
        """Shrink by how well the quadratic model predicted the decrease."""
        self.value = max(self.value * max(SHRINK, 1.0 - (2.0 * gain - 1.0) ** 3), SMALLEST)
        self.growth = 2.0


def gain(actual: float, predicted: float, slack: float) -> float | None:
    """Decrease of the merit over what the model promised; one where the promise is rounding, None where it falls short.

    Args:
        actual: decrease.
        predicted: decrease.
        slack: what counts as rounding.
    """
    if not actual >= SUFFICIENT * predicted - slack:
        return None
    return 1.0 if predicted <= slack else actual / predicted
