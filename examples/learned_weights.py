"""Weights of a controller learned from how it drives: the gradient of a closed loop through its optimal controls.

A controller of a short horizon brings a cart to rest, in a world with friction that is not in its model. It is the cost
of the whole drive that counts. ``solution.sensitivity(u[0], [here, *p])`` is how each control depends on the state and
on the sigmas p, limits included; the chain rule carries that along the drive, and twenty steps of descent follow.

    python examples/learned_weights.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.solvers import InteriorPoint

N, h, ticks, model, push = 8, 0.2, 60, np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
world, price = np.array([[1.0, h], [0.0, 1.0 - 0.4 * h]]), np.array([1.0, 0.1])  # with friction; of states
graph = fg.Graph()
x, u = graph.variables("x", fg.Rn(2), N + 1), graph.variables("u", fg.Rn(1), N)
here, p = graph.data("here", [0.0, 0.0]), [graph.data(name, 1.0) for name in ("of p", "of v", "of u")]
graph.fix(x[0], here)
graph.minimize(lambda x: x[:, :1], x[1:], sigma=p[0], name="position")
graph.minimize(lambda x: x[:, 1:], x[1:], sigma=p[1], name="speed")
graph.minimize(fg.prior, u, [0.0], sigma=p[2], name="effort")
graph.constrain(lambda x, u, y: y - x @ model.T - u @ push.T, x[:-1], u, x[1:], lower=0, upper=0, name="motion")
graph.bound(u, lower=-1.0, upper=1.0, name="limits")
run = InteriorPoint(tolerance=1e-10).prepare(graph)


def drive(sigmas: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost of a drive, its gradient by the logarithms of the sigmas, and (ticks, 3) states and controls."""
    cost, gradient, rows, state, by = 0.0, np.zeros(3), np.zeros((ticks, 3)), np.array([3.0, 0.0]), np.zeros((2, 3))
    for k in range(ticks):
        guess = {x: np.tile(state, (N + 1, 1)), u: np.zeros((N, 1))}
        solution = run.solve(guess, data={here: state, **dict(zip(p, sigmas, strict=True))}, check=True)
        slope, control = solution.sensitivity(u[0], [here, *p]), solution[u][0]
        of_control = slope[:, :2] @ by + slope[:, 2:] * sigmas
        cost, rows[k] = cost + state @ (price * state) + 0.3 * control @ control, [*state, *control]
        gradient += 2.0 * (price * state) @ by + 0.6 * control @ of_control
        state, by = world @ state + push @ control, world @ by + push @ of_control
    return cost, gradient, rows


sigmas, runs = np.ones(3), [drive(np.ones(3))]
for step in range(20):
    sigmas *= np.exp(-0.25 * 0.9**step * runs[-1][1] / np.linalg.norm(runs[-1][1]))
    runs.append(drive(sigmas))
print(f"cost of the drive {runs[0][0]:.1f}, after 20 steps {runs[-1][0]:.1f}; sigmas {sigmas.round(2)}")
figure, axes = plt.subplots(1, 2, figsize=(8.0, 2.6), layout="constrained")
axes[0].plot([cost for cost, *_ in runs], ".-")
axes[0].set(xlabel="step of descent", ylabel="cost of the drive")
axes[1].plot(h * np.arange(ticks), runs[0][2][:, ::2], ":", label=["position [m], before", "control, before"])
axes[1].plot(h * np.arange(ticks), runs[-1][2][:, ::2], label=["position [m], after", "control, after"])
axes[1].legend(title="over time [s]", fontsize=8)
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "learned_weights.png", dpi=80)
