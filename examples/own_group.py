"""A manifold of your own: an antenna slews between two directions and keeps 30 degrees away from the sun.

Directions are unit vectors, S2, no group. A step and its inverse in plain NumPy are enough: they are checked,
differentiated, compiled. The shortest way is known: two tangents of the sun's circle and an arc.

    python examples/own_group.py [FOLDER]
"""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint


class Sphere(fg.ManifoldBase):
    name, storage, dim = "S2", 3, 2

    def across(self, x: Any) -> Any:  # two directions at right angles to x, (..., 2, 3)
        v = x + np.where(x[..., 2:] < 0.0, -1.0, 1.0) * np.array([0.0, 0.0, 1.0])
        return np.eye(2, 3) - v[..., None, :] * x[..., :2, None] / (1.0 + np.abs(x[..., 2:, None]))

    def retract(self, x: Any, d: Any, /) -> Any:
        angle = np.linalg.norm(d, axis=-1, keepdims=True)
        return np.cos(angle) * x + np.sinc(angle / np.pi) * np.sum(d[..., None] * self.across(x), axis=-2)

    def local(self, x: Any, y: Any, /) -> Any:
        d = np.sum(self.across(x) * y[..., None, :], axis=-1)
        angle = np.arctan2(np.linalg.norm(d, axis=-1, keepdims=True), np.sum(x * y, axis=-1, keepdims=True))
        return d / np.sinc(angle / np.pi)

    def identity(self) -> Any:
        return np.array([0.0, 0.0, 1.0])

    def random(self, rng: np.random.Generator, /, shape: tuple[int, ...] = ()) -> Any:
        return self.retract(self.identity(), rng.uniform(-2.0, 2.0, (*shape, 2)))


S2, N, graph, away, off = Sphere(), 60, fg.Graph(), np.radians(30.0), np.array([[0.2, -0.9], [0.1, 0.8]])
x, sun, far = graph.variables("x", S2, N + 1), S2.identity(), np.linalg.norm(off, axis=1)
graph.fix(x[[0, N]], S2.retract(sun, off))
graph.minimize(lambda a, b: S2.local(a, b), x[:-1], x[1:], name="slew")
graph.constrain(lambda a: a @ sun[:, None], x, upper=np.cos(away), name="sun")
guess = {x: S2.retract(sun, np.linspace(off[0], off[1], N + 1))}
around = np.arccos(off[0] @ off[1] / np.prod(far)) - np.arccos(np.tan(away) / np.tan(far)).sum()
shortest = np.degrees(np.arccos(np.cos(far) / np.cos(away)).sum() + np.sin(away) * around)
print(fg.check_manifold(S2))
figure, ax = plt.subplots(figsize=(3.0, 3.6), subplot_kw={"aspect": "equal"}, layout="constrained")
for s in (solutions := [solver.solve(graph, guess) for solver in (SQP(), InteriorPoint(), AugmentedLagrangian())]):
    slew = np.degrees(np.sqrt(2.0 * N * s.cost))  # of N equal steps
    print(f"{s.solver:20} slews by {slew:.3f} deg, the shortest way has {shortest:.3f}, {s.status.name}")
    ax.plot(*np.degrees(S2.local(sun, s[x])).T, ".", 0.0, 0.0, "yo")
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "own_group.png", dpi=80)
