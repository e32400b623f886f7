"""Array types shared by the whole package."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]
Numbers: TypeAlias = Any
"""What becomes an array, as a value of a dictionary: ``{x: array, tree: [[1, 2.0]]}`` has no `ArrayLike` in common."""

__all__ = ["Array", "ArrayLike", "BoolArray", "IntArray", "Numbers"]
