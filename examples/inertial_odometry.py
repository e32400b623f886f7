"""Inertial odometry: gyro and accelerometer at 200 Hz, position fixes at irregular times, and biases nobody knows.

The samples between two nodes are one factor, a fix between two nodes another. For 2.5 s there are no fixes at all. Two
rounds: the samples are integrated at no bias first, then at the biases that were found.

    python examples/inertial_odometry.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.models import inertial, interpolation, preintegration, stamped
from unifg.solvers import LevenbergMarquardt

rng, noise, rate = np.random.default_rng(0), preintegration.ImuNoise(1e-3, 1e-2, 1e-4, 1e-3), 200
t, times, gps = np.arange(2400) / rate, np.linspace(0.0, 11.8, 60), 0.1  # samples and nodes [s]; [m]
bias = np.array([0.02, -0.03, 0.01, 0.2, -0.1, 0.15])  # of rates [rad/s] and forces [m/s^2]

# A figure of eight, banked: attitudes, accelerations, what an ideal sensor shows of them, and what this one does.
v = np.stack([3.0 * np.cos(0.6 * t), 4.0 * np.cos(1.2 * t), 0.4 * np.cos(0.8 * t)], axis=1)
q = fg.SO3.from_rpy(0.3 * np.sin(t), 0.1 * np.cos(t), np.arctan2(v[:, 1], v[:, 0]))
force = preintegration.at_rest(q) + fg.SO3.act(fg.SO3.inverse(q), np.gradient(v, t, axis=0))
ideal = np.concatenate([rate * fg.SO3.local(q[:-1], q[1:]), force[:-1]], axis=1)
clean = preintegration.preintegrate(t[:-1], ideal[:, :3], ideal[:, 3:], t, noise, np.zeros(6))
truth = preintegration.predict(fg.SE23.from_parts(np.zeros(3), v[0], q[0]), clean)
shown = ideal + bias + np.sqrt(rate) * np.repeat([1e-3, 1e-2], 3) * rng.normal(size=ideal.shape)
stamps = np.cumsum(rng.uniform(0.1, 0.6, 33))
stamps = stamps[(stamps < 6.0) | (stamps > 8.5)]
fixes = np.transpose([np.interp(stamps, t, p) for p in truth[:, :3].T]) + gps * rng.normal(size=(len(stamps), 3))

graph, between = fg.Graph(), interpolation.cubic(fg.SE23)
x, b = graph.variables("x", fg.SE23, len(times)), graph.variables("bias", preintegration.BIAS, len(times))
imu = inertial.InertialMeasurements(noise)
receiver = stamped.StampedMeasurements(lambda x, z: x[:, :3] - z, 3, capacity=3, sigma=gps, between=between, name="gps")
for sensor in (imu, receiver):
    sensor.state(graph, x)
graph.minimize(fg.prior, b[0], np.zeros(6), sigma=[0.05] * 3 + [0.3] * 3, name="start of biases")
graph.minimize(fg.prior, x[0], truth[0], sigma=[0.5] * 6 + [0.1] * 3, name="start")
imu.add(t[:-1], shown[:, :3], shown[:, 3:])
receiver.add(stamps, fixes)

run, found = LevenbergMarquardt().prepare(graph), np.zeros((len(times), 6))
for _ in range(2):
    guess = {x: preintegration.predict(truth[0], imu.integrated(times, found[:-1])), b: found}
    solution = run.solve(guess, data=imu.at(graph, times, found[:-1]) | receiver.at(graph, times), check=True)
    found = solution[b]
error = fg.SE23.local(truth[np.round(times * rate).astype(int)], solution[x])
sigma = np.sqrt(np.einsum("nii->ni", solution.marginals(x)))
print(f"off by {np.linalg.norm(error[:, :3], axis=1).max():.3f} m at most, by sigma {sigma[:, :3].max():.3f} m an axis")
figure, axes = plt.subplots(1, 2, figsize=(8.0, 2.8), layout="constrained")
axes[0].plot(*truth[:, :2].T, *fixes[:, :2].T, "x", *solution[x][:, :2].T, ".")
axes[1].plot(times, error[:, :3], times, 3.0 * sigma[:, :3], "k:", times, -3.0 * sigma[:, :3], "k:")
(folder := Path(*sys.argv[1:] or ["out"])).mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "inertial_odometry.png", dpi=80)
