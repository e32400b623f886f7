"""Watch a control loop in a browser while it runs: the plan, the robot and the time of each solve.

The scene is served on this machine; a frame is shown when its block ends, and the loop never waits for the browser. It
waits for one to come only if told so (--watch), and keeps the pace of the world then. The scene is also saved.

    python examples/live_view.py [FOLDER] [--watch]
"""

import sys
import time
from pathlib import Path

import numpy as np

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.solvers import InteriorPoint
from unifg.view import Scene

N, dt, ticks = 25, 0.1, 100
discs = np.array([[1.5, 0.1, 0.5], [3.0, -0.6, 0.5], [3.2, 1.0, 0.5]])  # x, y, radius [m]
graph = fg.Graph()
x, u = graph.variables("x", fg.SE2, N + 1), graph.variables("u", fg.Rn(2), N)
here, goal = graph.data("here", np.zeros(3)), np.array([4.5, 0.0, 0.0])
graph.fix(x[0], here)
graph.minimize(unicycle.tracking, x[1:], goal, sigma=[1.0, 1.0, 3.0], name="approach")
graph.minimize(fg.prior, u, [0.0, 0.0], sigma=[1.0, 1.0], name="effort")
graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
graph.constrain(obstacles.disc_clearance, x[1:], discs[:, :2], discs[:, 2] + 0.15, lower=0, name="discs")
graph.bound(u, lower=[-0.8, -1.5], upper=[0.8, 1.5])

scene = Scene("Live", dt=dt)
scene.body("robot", "disc", size=0.15)
scene.discs("obstacles", discs, height=0.4)
scene.plot("solve", unit="ms", log=True)
scene.view("robot", "follow", (-1.0, 0.0, 1.0), follows="robot", distance=4.0)
run, pose = InteriorPoint(tolerance=1e-4).prepare(graph), np.zeros(3)
guess = fg.Guess({x: np.linspace([0.0, 0.3, 0.0], goal, N + 1), u: np.zeros((N, 2))})
watch, plans = "--watch" in sys.argv, []
with scene.live() as live:
    print("open", live.url)
    while watch and not live.watching:
        time.sleep(0.1)
    for _ in range(ticks):
        plan = run.solve(guess, data={here: pose})
        with scene.frame() as frame:
            frame.place("robot", pose)
            frame.trail("driven", pose[:2])
            frame.way("plan", plan[x][:, :2])
            frame.value("solve", 1e3 * plan.seconds)
            frame.readout("status", plan.status.name, alarm=not plan.converged)
        plans.append(plan)
        pose, guess = unicycle.step(pose[None], plan[u[0]], dt)[0], plan.shifted(x, u)
        time.sleep(dt * watch)
folder = Path(*[word for word in sys.argv[1:] if word != "--watch"] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
print("saved", scene.save(folder / "live_view.html"), "; ends", pose.round(2))
plans[10].plot(x, u).savefig(folder / "live_view.png", dpi=80)
