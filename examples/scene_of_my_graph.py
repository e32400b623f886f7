"""A scene of any graph that you solve: a pose graph in space, how it was solved, and a drive along its answer.

A robot winds up a tower and sees what it saw one turn below. Three pages, each one file for any browser: the solution
with three-sigma ellipsoids and the closures as lines; its iterates, to be played; the robot on its way. Something of
one's own is drawn on a scene by the same methods.

    python examples/scene_of_my_graph.py [FOLDER]
"""

import sys
from pathlib import Path

import numpy as np

import unifg as fg
from unifg.solvers import LevenbergMarquardt
from unifg.view import Scene

turn, turns, rng = 24, 3, np.random.default_rng(0)
sigma = np.array([0.05, 0.05, 0.03, 0.005, 0.005, 0.02])
step = fg.SE3.exp([1.0, 0.0, 0.08, 0.0, 0.0, 2 * np.pi / turn])  # forwards, a little up, and left
truth, guess = np.tile(fg.SE3.identity(), (2, turn * turns + 1, 1))
for k in range(turn * turns):
    truth[k + 1] = fg.SE3.compose(truth[k], step)
    guess[k + 1] = fg.SE3.compose(guess[k], fg.SE3.retract(step, sigma * rng.normal(size=6)))
first = np.arange(0, len(truth) - turn, 4)
seen = fg.SE3.between(truth[first], truth[first + turn])

graph = fg.Graph()
x = graph.variables("x", fg.SE3, len(truth))
graph.fix(x[0], truth[0])
graph.minimize(fg.between, x[:-1], x[1:], fg.SE3.between(guess[:-1], guess[1:]), sigma=sigma, name="odometry")
graph.minimize(fg.between, x[first], x[first + turn], seen, sigma=2.0 * sigma, name="closures")
solution = LevenbergMarquardt(keep_values=True).solve(graph, {x: guess}, check=True)
print(solution.report())

folder = Path(*sys.argv[1:] or ["out"])
folder.mkdir(parents=True, exist_ok=True)
scene = Scene.of(solution, x, sigmas=3.0, terms=["closures"], title="A tower")
scene.way("truth", truth[:, :3], colour="goal")  # of one's own
pages = [
    scene.save(folder / "solution.html"),
    Scene.of(solution, x, over="iterates", title="How it was solved").save(folder / "iterates.html"),
    Scene.of(solution, x, over="members", dt=0.1, body="quadrotor", title="A flight").save(folder / "flight.html"),
]
print("open", *pages)
solution.plot(marginals=True).savefig(folder / "scene_of_my_graph.png", dpi=70)
