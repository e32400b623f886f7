"""METIS' order, where the extra ``unifg[metis]`` is installed.

Multilevel nested dissection (G. Karypis, V. Kumar, "A fast and high quality multilevel scheme for partitioning
irregular graphs", SIAM J. Sci. Comput. 20 (1998)) finds smaller separators than our own dissection in graphs whose
breadth-first levels say little of their shape, as those of a robot that comes back at random. METIS seeds its generator
anew in every call: one graph has one order.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from unifg.errors import UnifgError
from unifg.typing import IntArray


def installed() -> bool:
    """Test whether the extra is there."""
    return find_spec("pymetis") is not None


def metis_order(pointer: IntArray, neighbours: IntArray, weight: IntArray) -> IntArray:
    """Nodes of a graph in the order of elimination.

    Args:
        pointer: symmetric graph.
        neighbours: see above; no node is its own.
        weight: (nodes,) scalars of each node.

    Raises:
        UnifgError: the extra is not installed.
    """
    if not installed():
        raise UnifgError("ordering 'metis' needs pymetis: pip install 'unifg[metis]'")
    if not len(neighbours):
        return np.arange(len(pointer) - 1, dtype=np.int64)
    import pymetis

    order, _ = pymetis.nested_dissection(pymetis.CSRAdjacency(pointer, neighbours), vweights=weight)
    return np.asarray(order, dtype=np.int64)
