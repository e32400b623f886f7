"""Range-only SLAM with echoes: which loss finds four beacons whose places nobody knows?

A robot drives a loop by odometry and hears its distance to four beacons. One range in six is an echo, up to 5 m too
long. Least squares believes them all; Huber and Cauchy believe them less; graduated non-convexity leaves them out. The
marginals say how sure each answer is of the beacons: it is consistent if its errors lie within three sigma.

    python examples/range_only_slam.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.solvers import GraduatedNonConvexity, LevenbergMarquardt

N, sigma, rng = 80, np.array([0.03, 0.01, 0.01]), np.random.default_rng(2)
truth, drifted = np.zeros((N + 1, 3)), np.zeros((N + 1, 3))
for k in range(N):
    step = fg.SE2.exp([0.4, 0.0, 0.1 * np.sin(0.15 * k) + 2.0 * np.pi / N])
    truth[k + 1] = fg.SE2.compose(truth[k], step)
    drifted[k + 1] = fg.SE2.compose(drifted[k], fg.SE2.retract(step, sigma * rng.standard_normal(3)))
places = np.array([[-2.0, -2.0], [6.0, 0.0], [4.0, 9.0], [-6.0, 6.0]])
pose, beacon = np.repeat(np.arange(N + 1), 4), np.tile(np.arange(4), N + 1)
heard = np.linalg.norm(truth[pose, :2] - places[beacon], axis=1) + 0.1 * rng.standard_normal(len(pose))
echoes = rng.random(len(pose)) < 1 / 6
heard += echoes * rng.uniform(1.0, 5.0, len(pose))

losses = {"none": None, "Huber": fg.Huber(1.345), "Cauchy": fg.Cauchy(1.0), "GNC": fg.TruncatedLeastSquares(3.0)}
results, (figure, ax) = {}, plt.subplots(figsize=(5.0, 4.4), layout="constrained")
for name, loss in losses.items():
    graph = fg.Graph()
    x, m = graph.variables("x", fg.SE2, N + 1), graph.variables("m", fg.Rn(2), 4)
    graph.fix(x[0], truth[0])
    graph.minimize(fg.between, x[:-1], x[1:], fg.SE2.between(drifted[:-1], drifted[1:]), sigma=sigma, name="odometry")
    distance = lambda p, b, seen: np.linalg.norm(p[:, :2] - b, axis=1, keepdims=True) - seen  # noqa: E731
    graph.minimize(distance, x[pose], m[beacon], heard[:, None], sigma=0.1, robust=loss, name="ranges")
    solver = GraduatedNonConvexity() if name == "GNC" else LevenbergMarquardt()
    s = solver.solve(graph, {x: drifted, m: places + 1.5})  # beacons are known to 2 m to begin with
    error, wrong = s[m] - places, (s.residuals["ranges"] > 3.0) != echoes
    far = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(s.marginals(m)), error)).max()
    results[name] = s, np.linalg.norm(error, axis=1).max(), far, wrong.sum()
    print(f"{name:7} beacons off by up to {results[name][1]:.2f} m, {far:.1f} sigma; {wrong.sum()} ranges misjudged")
    ax.plot(*s[m].T, "x", ms=9, label=name)
ax.plot(*truth[:, :2].T, "k-", *places.T, "k+", ms=15)
ax.axis("equal")
ax.legend(title="loss")
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "range_only_slam.png", dpi=80)
