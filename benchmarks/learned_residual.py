"""A network that learns in flight what the model of a quadrotor leaves out, beside mass and drag, in a figure eight.

The vehicle has a drag that grows with the square of its speed and a lift in forward flight; its model has a mass and a
linear drag. A network of two layers, a NumPy function like the rest of the model, adds an acceleration in the body. Its
weights are constants of the robot like mass and drag: unknowns of the window of the past, known to the plan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import unifg as fg
from benchmarks.comparison import Row, against, mean, where
from benchmarks.report import listing
from benchmarks.runner import Study, every
from unifg.horizon import Constant, Context, ControlCost, Dynamics, Measurement, RecedingHorizon, Robot, Term, Window
from unifg.models import quadrotor
from unifg.solvers import InteriorPoint
from unifg.typing import Array

STEPS, TICK = 16, 0.05  # [s]
LAPS, LAP = 3, 100  # ticks of a lap
HIDDEN = 6
FIRST, SECOND = 4 * HIDDEN, 3 * HIDDEN + 3  # weights and offsets of each layer
NOISE = np.repeat([0.002, 0.003, 0.01], 3)  # of position [m], attitude [rad], velocity [m/s]
PROCESS = np.repeat([0.001, 0.001, 0.01], 3)  # of a step
MASS, DRAG, LIFT = 1.2, 0.25, 0.12  # of the vehicle [kg, 1/m, 1/m]; its model begins with 1 kg and no drag
ESTIMATED = ("mass", "drag", "weights")
MODELS = {"mass and drag": 0.0, "mass, drag and a network": 0.5}
"""Standard deviation of the weights at the start; with zero they are known, and the network says nothing."""


def eight(ticks: int) -> Array:
    """(ticks, 3) wanted places [m]."""
    phase = 2.0 * np.pi * np.arange(ticks) / LAP
    return np.stack([2.5 * np.sin(phase), 1.2 * np.sin(2.0 * phase), np.full(ticks, 2.0)], axis=1)


def flow(x: Array) -> Array:
    """(n, 3) velocity in the body [m/s]."""
    return fg.SO3.act(fg.SO3.inverse(x[:, 3:7]), x[:, 7:10])


def falling(x: Array, body: Array) -> Array:
    """(n, 3) acceleration in the world by what pushes in the body, and by gravity [m/s^2]."""
    return np.asarray(fg.SO3.act(x[:, 3:7], body) - [0.0, 0.0, quadrotor.GRAVITY])


def network(air: Array, weights: Array) -> Array:
    """(n, 3) acceleration in the body [m/s^2] by the velocity ``air`` (n, 3) there."""
    first = weights[:, :FIRST].reshape(-1, HIDDEN, 4)
    second = weights[:, FIRST:].reshape(-1, 3, HIDDEN + 1)
    inner = np.tanh(layer(first, air / 3.0))
    return layer(second, inner)


def layer(weights: Array, given: Array) -> Array:
    """(n, k) outputs of a layer with weights (n, k, m + 1), the last ones offsets, for inputs (n, m)."""
    products = weights[:, :, :-1] * given[:, None, :]
    outputs: Array = products.sum(axis=2) + weights[:, :, -1]
    return outputs


def modelled(x: Array, u: Array, mass: Array, drag: Array, weights: Array) -> Array:
    """(n, 3) acceleration by the model [m/s^2]."""
    air = flow(x)
    body = u[:, 3:] * [0.0, 0.0, 1.0] / mass - drag * air / mass + network(air, weights)
    return falling(x, body)


def motion(x: Array, u: Array, mass: Array, drag: Array, weights: Array, after: Array, step: Any) -> Array:
    """(n, 9) defect of a step by the trapezoid."""
    known = mass, drag, weights
    meant = 0.5 * (modelled(x, u, *known) + modelled(after, u, *known))
    speed = 0.5 * (x[:, 7:10] + after[:, 7:10])
    ahead = after[:, :3] - x[:, :3] - step * speed
    turned = fg.SO3.compose(fg.SO3.inverse(x[:, 3:7]), after[:, 3:7])
    turn = fg.SO3.log(turned) - step * u[:, :3]
    return np.concatenate([ahead, turn, after[:, 7:10] - x[:, 7:10] - step * meant], axis=1)


def true(x: Array, u: Array) -> Array:
    """(n, 3) acceleration of the vehicle [m/s^2]."""
    air = flow(x)
    speed = np.linalg.norm(air, axis=1, keepdims=True)
    lift = LIFT * np.square(air[:, :2]).sum(axis=1, keepdims=True)
    body = (u[:, 3:] / MASS + lift) * [0.0, 0.0, 1.0] - DRAG * speed * air
    return falling(x, body)


def flown(state: Array, control: Array, parts: int = 10) -> Array:
    """State of the vehicle after a tick."""
    x, u = state[None].copy(), control[None]
    step = TICK / parts
    for _ in range(parts):
        pull = true(x, u)
        x[:, :3] += step * (x[:, 7:10] + 0.5 * step * pull)
        x[:, 7:10] += step * pull
        x[:, 3:7] = fg.SO3.retract(x[:, 3:7], step * u[:, :3])
    after: Array = x[0]
    return after


class Eight:
    """Wanted places of the next nodes, and limits."""

    def state(self, graph: fg.Graph, x: Any, u: Any) -> None:
        """Add them."""
        wanted = graph.data("wanted", np.zeros((STEPS, 3)), each=True)
        graph.minimize(fg.prior, x[1:].p, wanted, sigma=0.05, name="eight")
        graph.bound(u, lower=[-8.0, -8.0, -4.0, 2.0], upper=[8.0, 8.0, 4.0, 30.0], name="limits")

    def data(self, now: Context[Array]) -> Mapping[str, Array]:
        """Places from the tick on."""
        return {"wanted": now.given}


def loop_of(start: Array, sigma: float, rng: np.random.Generator) -> RecedingHorizon:
    """Loop whose past estimates mass, drag and weights, and whose plan takes them."""
    books = quadrotor.Parameters()
    weights = np.concatenate([rng.normal(0.0, 1.0, FIRST), np.zeros(SECOND)])
    mass = Constant("mass", fg.Rn(1), [[1.0]], 0.2)
    drag = Constant("drag", fg.Rn(3), [[0.0, 0.0, 0.0]], 0.3)
    learned = Constant("weights", fg.Rn(FIRST + SECOND), [weights], sigma)
    robot = Robot(
        quadrotor.STATE, quadrotor.CONTROL, (mass, drag, learned), predict=lambda x, u: quadrotor.fly(x, u, TICK, books)
    )
    seen = Measurement("seen", fg.prior, (10,), NOISE)
    past: list[Term] = [seen, Dynamics(motion, TICK, PROCESS, constants=ESTIMATED)]
    window = Window(robot, 10, past, start=start, sigma=NOISE, solver=InteriorPoint(tolerance=1e-3))
    effort = ControlCost(sigma=[4.0, 4.0, 2.0, 6.0], wanted=quadrotor.hover(books))
    future: list[Term] = [Dynamics(motion, TICK, constants=ESTIMATED), Eight(), effort]
    return RecedingHorizon(robot, STEPS, future, solver=InteriorPoint(tolerance=1e-4), window=window)


def measure(seed: int, model: str) -> Row:
    """Fly once."""
    rng = np.random.default_rng(seed)
    wanted = eight(LAPS * LAP + STEPS + 1)
    x = quadrotor.STATE.pack(p=wanted[0], R=fg.SO3.identity(), v=(wanted[1] - wanted[0]) / TICK)
    loop = loop_of(x, MODELS[model], rng)
    off = np.zeros(LAPS * LAP)
    missing = np.zeros(LAPS * LAP)
    for tick in range(LAPS * LAP):
        noise = NOISE * rng.normal(size=9)
        seen = quadrotor.STATE.retract(x, noise)
        plan = loop.tick(wanted[tick + 1 : tick + STEPS + 1], {"seen": seen})
        u = plan.control[None]
        known = [loop.constants[name] for name in ESTIMATED]
        error = true(x[None], u) - modelled(x[None], u, *known)
        x = flown(x, plan.control)
        off[tick] = np.linalg.norm(x[:3] - wanted[tick + 1])
        missing[tick] = np.linalg.norm(error)
    by_lap = np.square(off).reshape(LAPS, LAP)
    laps = 1e3 * np.sqrt(by_lap.mean(axis=1))
    found: Row = {f"lap {lap + 1}": float(value) for lap, value in enumerate(laps)}
    found["missing"] = float(np.sqrt(np.square(missing[-LAP:]).mean()))
    found["solved"] = loop.sources["solved"]
    found["tick"], found["late tick"] = np.percentile(loop.milliseconds, [50, 99]).tolist()
    return found


def tables(rows: list[Row]) -> str:
    """Distances from the path and errors of the model, side by side."""
    groups = {(model,): where(rows, model=model) for model in MODELS}
    base = groups[next(iter(groups))]

    def beside(name: str) -> Callable[[list[Row]], str]:
        return lambda own: against(own, base, lambda row: row[name])

    heads = {f"lap {lap + 1} [mm rms]": beside(f"lap {lap + 1}") for lap in range(LAPS)}
    heads["error of the acceleration, lap 3 [m/s^2 rms]"] = beside("missing")
    heads |= {"tick, median [ms]": mean("tick"), "p99": mean("late tick"), "plans solved": mean("solved")}
    notes = f"{len(base)} flights of {LAPS * LAP} ticks each; intervals of paired differences."
    return f"{listing(['estimated'], groups, heads)}\n\n{notes}"


STUDY = Study(every(model=MODELS), measure, tables, range(10))
