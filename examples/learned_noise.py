"""Noise levels of a smoother learned from ground truth: the gradient of its error by its sigmas, which are data.

The smoother trusts its odometry ten times more than it should, and measured positions three times less. The gradient of
the squared error of its positions by all sigmas is one adjoint solve for each of six drives whose truth is known.
Ratios of sigmas alone make a difference to an estimate; what is learned is tried on drives that were not seen.

    python examples/learned_noise.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.models import unicycle
from unifg.solvers import LevenbergMarquardt

N, noise, gps, rng = 60, np.array([0.03, 0.01, 0.05]), 0.15, np.random.default_rng(0)  # of a step, of a position
graph = fg.Graph()
x = graph.variables("x", fg.SE2, N + 1)
steps, places = graph.data("steps", np.zeros((N, 3)), each=True), graph.data("places", np.zeros((N, 2)), each=True)
sigmas = graph.data("of steps", [0.003, 0.001, 0.005]), graph.data("of places", [0.45, 0.45])
graph.minimize(fg.prior, x[0], np.zeros(3), sigma=[0.05, 0.05, 0.02], name="start")
graph.minimize(fg.between, x[:-1], x[1:], steps, sigma=sigmas[0], name="odometry")
graph.minimize(lambda x, z: x[:, :2] - z, x[1:], places, sigma=sigmas[1], name="positions")
run = LevenbergMarquardt(tolerance=1e-9).prepare(graph)
drives = []
for _ in range(12):
    control, truth = np.stack([np.ones(N), np.cumsum(0.3 * rng.normal(size=N))], axis=1), np.zeros((N + 1, 3))
    for k in range(N):
        truth[k + 1] = unicycle.step(truth[k : k + 1], control[k : k + 1], 0.2)[0]
    odometry = fg.SE2.retract(fg.SE2.between(truth[:-1], truth[1:]), noise * rng.normal(size=(N, 3)))
    drives.append((truth, {steps: odometry, places: truth[1:, :2] + gps * rng.normal(size=(N, 2))}))

costs, logs, found = np.zeros(31), np.log(np.r_[sigmas[0].value, sigmas[1].value]), {}
for step in range(31):
    total, slope = 0.0, np.zeros(5)
    for number, (truth, data) in enumerate(drives):
        now = {**data, sigmas[0]: np.exp(logs[:3]), sigmas[1]: np.exp(logs[3:])}
        solution = run.solve({x: truth}, data=now, check=True)
        off, heading = (solution[x] - truth)[:, :2], solution[x][:, 2:]
        turned = np.cos(heading) * off + np.sin(heading) * off[:, ::-1] * [1.0, -1.0]  # in the frame of the pose
        by = {x: 2.0 * np.hstack([turned, 0.0 * heading])}
        if number < 6:
            slope += np.concatenate([solution.gradient(by, sigma) for sigma in sigmas]) * np.exp(logs)
        else:
            total += (off**2).sum() / (6 * N)
    costs[step], found[step] = np.sqrt(total), solution[x]
    logs = logs - 0.4 * 0.93**step * slope / np.linalg.norm(slope)
print(f"error of unseen drives {costs[0]:.3f} m, after 30 steps {costs[-1]:.3f} m")
figure, ax = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
for name, path in (("truth", truth), ("before", found[0]), ("learned", found[30])):
    ax.plot(*path[:, :2].T, label=name)
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend()
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "learned_noise.png", dpi=80)
