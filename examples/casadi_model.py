"""A model written in CasADi: a crane brings its load to rest, four metres on, and never lets it swing by 0.1 rad.

fg.from_casadi reads the scalar instructions of a casadi.Function once; derivatives are exact by the same route as those
of NumPy, and nothing of CasADi runs afterwards. The crane's step is one of Runge and Kutta, written in CasADi.

    python examples/casadi_model.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import unifg as fg
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint

try:
    import casadi as ca
except ImportError:
    sys.exit('this example needs CasADi: pip install "unifg[casadi]"')

N, h, length, gravity = 60, 0.08, 2.0, 9.81
x, u, y = ca.SX.sym("x", 4), ca.SX.sym("u", 1), ca.SX.sym("y", 4)  # trolley, angle, their rates; acceleration
swing = -(u * ca.cos(x[1]) + gravity * ca.sin(x[1])) / length
f = ca.Function("f", [x, u], [ca.vertcat(x[2:], u, swing)])
k1 = f(x, u)
k2 = f(x + h / 2 * k1, u)
k3 = f(x + h / 2 * k2, u)
step = ca.Function("step", [x, u], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3, u))])
motion = fg.from_casadi(ca.Function("motion", [x, u, y], [y - step(x, u)]))

graph = fg.Graph()
state, push = graph.variables("state", fg.Rn(4), N + 1), graph.variables("push", fg.Rn(1), N)
ends = np.array([[0.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0]])
graph.fix(state[[0, N]], ends)
graph.minimize(fg.prior, push, [0.0], sigma=1.0, name="effort")
graph.constrain(motion, state[:-1], push, state[1:], lower=0, upper=0, name="motion")
graph.bound(push, lower=-2.0, upper=2.0)
graph.constrain(lambda x: x[:, 1:2], state, lower=-0.1, upper=0.1, name="swing")
guess = {state: np.linspace(ends[0], ends[1], N + 1), push: np.zeros((N, 1))}

solutions, (figure, (path, angle)) = {}, plt.subplots(1, 2, figsize=(8.0, 2.6), layout="constrained")
for solver in (SQP(), AugmentedLagrangian(), InteriorPoint()):
    s = solutions[solver.name] = solver.solve(graph, guess)
    reached = ends[0]
    for a in s[push]:
        reached = np.asarray(step(reached, a)).ravel()  # by CasADi itself
    print(f"{solver.name:20} cost {s.cost:.4f}, {s.status.name}; CasADi's own step ends at {reached.round(4)}")
    path.plot(h * np.arange(N + 1), s[state][:, 0])
    angle.plot(h * np.arange(N + 1), np.degrees(s[state][:, 1]), label=solver.name)
path.set(xlabel="time [s]", ylabel="trolley [m]")
angle.set(xlabel="time [s]", ylabel="swing [deg]")
angle.legend(fontsize=8)
folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "casadi_model.png", dpi=80)
