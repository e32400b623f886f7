"""Parts of the elimination tree that know nothing of each other and can be eliminated at once.

Subtrees are split, the heaviest first, until none holds more than a quarter of the work, and gathered in parts; what is
above them is left for the end.
J. Liu, "Task scheduling for parallel sparse Cholesky factorization", Int. J. Parallel Programming 18 (1989).
"""

from __future__ import annotations

import numpy as np

from unifg.codegen.jit import compiled
from unifg.elimination.ordering import filled
from unifg.elimination.plan import CHILD, PIVOTS, ROWS, SIBLING
from unifg.typing import IntArray

PARTS = 8
SHARE = 0.25  # of the work, above which a subtree is split
WORTH = 2e7  # multiplications below which threads bring nothing
OVERHEAD = 30.0  # of a scalar of a front, in multiplications
MANY = 256  # subtrees at most that are split, and put into order


@compiled
def share_out(fronts: IntArray, parent: IntArray) -> IntArray:
    """(S,) part of every front, PARTS for those above all subtrees; empty where there is too little work.

    Args:
        fronts: with pivots, rows, children and siblings.
        parent: (S,) of each front, or -1.
    """
    count = len(parent)
    below = np.zeros(count)
    total, jobs = 0.0, 0
    job = filled(count, -1)
    for s in range(count):
        w, size = float(fronts[s, PIVOTS]), float(fronts[s, PIVOTS] + fronts[s, ROWS])
        work = w * size * size + OVERHEAD * size
        below[s] += work
        total += work
        if parent[s] >= 0:
            below[parent[s]] += below[s]
        else:
            job[jobs] = s
            jobs += 1
    if total < WORTH:
        return filled(0, 0)
    for _ in range(MANY):
        heaviest = 0
        for k in range(jobs):
            if below[job[k]] > below[job[heaviest]]:
                heaviest = k
        s = job[heaviest]
        if below[s] <= SHARE * total:
            break
        jobs -= 1
        job[heaviest] = job[jobs]
        child = fronts[s, CHILD]
        while child >= 0:
            job[jobs] = child
            jobs += 1
            child = fronts[child, SIBLING]
        if jobs == 0:
            return filled(0, 0)
    part, load = filled(count, -1), np.zeros(PARTS)
    for k in range(jobs):
        if k < MANY:  # the heaviest in order; where there are more the rest is too light for its order to matter
            heaviest = k
            for other in range(k + 1, jobs):
                if below[job[other]] > below[job[heaviest]]:
                    heaviest = other
            job[k], job[heaviest] = job[heaviest], job[k]
        lightest = 0
        for p in range(PARTS):
            if load[p] < load[lightest]:
                lightest = p
        part[job[k]] = lightest
        load[lightest] += below[job[k]]
    for s in range(count - 1, -1, -1):
        if part[s] < 0:
            above = PARTS if parent[s] < 0 else part[parent[s]]
            part[s] = above
    return part
