"""A solver as a C function in a control loop (it needs a C compiler), beside the same solver in Python: the same bits.

python examples/deployed_loop.py [FOLDER]
"""

import ctypes
import re
import sys
from pathlib import Path
from time import perf_counter

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint

N, s = 20, np.linspace(0.0, 2.0, 21)
graph = fg.Graph()
x, u, here = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N), graph.data("here", np.zeros(3))
graph.fix(x[0], here)
graph.minimize(fg.prior, x[1:], [2.0, 0.0, 0.0], sigma=[1.0, 1.0, 3.0], name="goal")
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0, name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], np.array([[1.0, 0.05]]), np.array([0.4]), lower=0, name="disc")
graph.bound(u, lower=[-0.2, -2.0], upper=[1.0, 2.0], name="limits")
run = InteriorPoint(tolerance=1e-4, max_iterations=60).prepare(graph)
last = run.solve({x: np.column_stack([s, np.sin(1.5 * s), 0 * s]), u: np.tile([1.0, 0.0], (N, 1))}, check=True)
files = run.export((folder := Path(*sys.argv[1:] or ["out"])) / "plan", name="plan")
size = {name: int(number) for name, number in re.findall(r"PLAN_(\w+) = (\d+),", files[0].read_text())}
in_c = ctypes.CDLL(str(files[-1].resolve())).plan_solve
values, multipliers = (np.concatenate([a.ravel() for a in own.values()]) for own in (last.values, last.multipliers))
pose, report, memory = np.zeros(3), np.zeros(size["REPORT"]), ctypes.create_string_buffer(size["WORKSPACE"] + 64)
workspace = ctypes.c_void_p(ctypes.addressof(memory) // 64 * 64 + 64)
arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (pose, *2 * (values, multipliers), report)]

rows, same = [], True
for _ in range(60):
    began, answer, between = perf_counter(), in_c(*arrays, workspace), perf_counter()
    last = run.solve(last, data={here: pose}, check=True)
    same = (
        same and answer == size["CONVERGED"] and np.array_equal(values, np.concatenate([last[x], last[u]], axis=None))
    )
    rows.append([*pose, 1e6 * (between - began), 1e6 * (perf_counter() - between)])
    pose[:] = fg.SE2.retract(pose, 0.1 * np.insert(last[u][0], 1, 0.0)).ravel()
drive = np.array(rows)
c, python = np.median(drive[:, 3:], axis=0)
print(f"the same bits in all ticks: {same}; a tick takes {c:.0f} us in C and {python:.0f} in Python, in the median")

figure, (plan, over) = plt.subplots(2, layout="constrained", figsize=(6.0, 4.6))
plan.add_patch(Circle((1.0, 0.05), 0.4, color="0.8"))
plan.plot(*drive[:, :2].T)
plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
over.semilogy(0.1 * np.arange(60), drive[:, 3:], label=["in C", "in Python"])
over.set(xlabel="time [s]", ylabel="a tick takes [us]")
over.legend()
figure.savefig(folder / "deployed_loop.png", dpi=80)
