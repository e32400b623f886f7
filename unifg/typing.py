"""Types of arrays and pictures shared by the whole package."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:  # matplotlib is loaded where something is drawn
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]
Records: TypeAlias = NDArray[np.void]
Numbers: TypeAlias = Any
"""What becomes an array, as a value of a dictionary: ``{x: array, tree: [[1, 2.0]]}`` has no `ArrayLike` in common."""

__all__ = ["Array", "ArrayLike", "Axes", "BoolArray", "Figure", "IntArray", "Numbers"]
