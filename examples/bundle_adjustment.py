"""Bundle adjustment: cameras around a tower, and points on it, from pixels of which a tenth are wrong.

Poses are known to decimetres and degrees, focal lengths to 2 %. Points are triangulated from these, the problem goes
through a file of the BAL format, and poses, intrinsics and points are adjusted, by squares and with a robust loss.

    python examples/bundle_adjustment.py [FOLDER]
"""

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.files.bal import read_bal, write_bal
from unifg.models.bundle_adjustment import BundleAdjustment, project, triangulate
from unifg.solvers import LevenbergMarquardt

rng, cameras, size = np.random.default_rng(0), 16, 800
side, zero = rng.uniform(-np.pi, np.pi, size), np.zeros(cameras)
points = np.column_stack([2.0 * np.sin(side), rng.uniform(-2.0, 2.0, size), 2.0 * np.cos(side)])
turn = np.linspace(-2.5, 2.5, cameras)  # of a camera around the tower, which it looks at from 9 m away
moved = np.column_stack([zero, np.cos(3.0 * turn), zero - 9.0])
poses = np.column_stack([moved, np.cos(turn / 2), zero, -np.sin(turn / 2), zero])
intrinsics = np.tile([800.0, -0.05, 0.01], (cameras, 1))
camera, point = np.nonzero(np.cos(turn[:, None] - side) > 0.3)  # what is on its side
pixels = project(poses[camera], intrinsics[camera], points[point]) + rng.normal(0.0, 0.5, (len(camera), 2))
wrong = rng.random(len(camera)) < 0.1
pixels[wrong] += rng.normal(0.0, 50.0, (wrong.sum(), 2))

noise = np.vstack([np.zeros(6), rng.normal(0.0, [0.2, 0.2, 0.2, 0.03, 0.03, 0.03], (cameras - 1, 6))])
begun = BundleAdjustment(camera, point, pixels, fg.SE3.retract(poses, noise), intrinsics * [1.02, 1, 1], 0 * points)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
begun = read_bal(write_bal(folder / "tower.txt", replace(begun, points=triangulate(begun))))
found, focal = {"triangulated": begun.points}, {}
for name, loss in (("squares", None), ("Cauchy", fg.Cauchy(2.0))):
    graph, guess = begun.graph(sigma=0.5, robust=loss)
    solution = LevenbergMarquardt().solve(graph, guess)
    found[name], focal[name] = solution["points"], solution["intrinsics"][:, 0]
    print(f"{name}: {solution.status.name}, {solution.iterations} iterations, focal length {focal[name].mean():.1f}")

figure, axes = plt.subplots(1, 3, figsize=(8.0, 3.2), layout="constrained", sharex=True, sharey=True)
errors = {}
for ax, (name, own) in zip(axes, found.items(), strict=True):
    errors[name] = np.median(np.linalg.norm(own - points, axis=1))
    ax.plot(own[:, 0], own[:, 2], "k.", markersize=2)
    ax.set(aspect="equal", xlim=(-4, 4), ylim=(-4, 4), title=f"{name}: {100 * errors[name]:.1f} cm", xlabel="x [m]")
axes[0].set(ylabel="z [m]")
figure.savefig(folder / "bundle_adjustment.png", dpi=80)
