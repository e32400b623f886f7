"""The least distance from a path that noise and gusts leave, whoever decides: the linear loop about hover.

Near a path that asks for little, a quadrotor is two chains of integrators, twice level and once up,

    p' = v,  v' = g theta + gust,  theta' = rate,  the loop of the rates;      p' = v,  v' = thrust + gust,  its lag

with noise that is Gaussian, looks with noise at every tick, and commands that act two ticks later. What a controller
then leaves is the stationary covariance of a linear system, the solution of a Lyapunov equation: nothing is drawn, and
no seed can be tuned on. Compared are flatness and plan with the numbers they fly with and with the best there are, by
the same search (:func:`scipy.optimize.minimize`, Nelder-Mead, :data:`EVALUATIONS` each), and the linear-quadratic
regulator that knows everything, below which no feedback gets at the same effort: commands up to :data:`EFFORT`, rms.

    python -m benchmarks.flight_floor
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal, TypeAlias

import numpy as np
import scipy.linalg
from scipy.optimize import minimize

from benchmarks.report import command, table
from unifg.models.quadrotor import GRAVITY
from unifg.scenarios.safe_flight import SafeSettings
from unifg.scenarios.safety.cbf_mpc import TRACKING
from unifg.scenarios.safety.flatness import TUNED
from unifg.scenarios.simulation.body_rate import Loops
from unifg.typing import Array

Axis: TypeAlias = Literal["level", "up"]
Feedback: TypeAlias = tuple[Array, float, float]  # of the state, of the last command, of the one before

EFFORT = 3.0  # rms of the commands: body rates [rad/s], thrust over mass [m/s^2]
EVALUATIONS = 300
LATE = 2  # ticks until a command acts, as the books have it
AHEAD = 6  # ticks that flatness looks ahead
SIZE = {"level": 6, "up": 4}
AIR = SafeSettings().disturbance
DT = SafeSettings().dt


@cache
def held(axis: Axis, loops: Loops, duration: float) -> tuple[Array, Array, Array]:
    """State matrix, input (n,) and noise (n, m) of a time in which all of them are held; the gust, the last, is."""
    n = SIZE[axis]
    slope = np.zeros((n, n))
    told = np.zeros(n)
    if axis == "level":
        slope[0, 1], slope[1, 2], slope[1, 5], slope[2, 3], slope[3, 4] = 1.0, GRAVITY, 1.0, 1.0, 1.0
        slope[4, 3], slope[4, 4], told[4] = -loops.gain / loops.lag, -1.0 / loops.lag, loops.gain / loops.lag
        noisy = np.eye(n)[:, [2, 1]]
    else:
        slope[0, 1], slope[1, 2], slope[1, 3] = 1.0, 1.0, 1.0
        slope[2, 2], told[2] = -1.0 / loops.lag, 1.0 / loops.lag
        noisy = np.eye(n)[:, [1]]
    whole = np.zeros((n + 1 + noisy.shape[1],) * 2)
    whole[:n] = np.column_stack([slope, told, noisy])
    found = scipy.linalg.expm(duration * whole)
    return found[:n, :n], found[:n, n], found[:n, n + 1 :]


@cache
def chain(axis: Axis, loops: Loops) -> tuple[Array, Array, Array, Array, Array]:
    """Of a tick: state matrix, input (n,), noise (n, n), what is seen (m, n), and its noise (m, m)."""
    step, told, noisy = held(axis, loops, DT)
    n, keep = SIZE[axis], float(np.exp(-DT / AIR.gust_time))
    step = step.copy()
    step[-1, -1] = keep
    sigma = np.array([AIR.rate_density, AIR.acceleration_density][-noisy.shape[1] :]) / np.sqrt(DT)
    noise = (noisy * sigma**2) @ noisy.T
    noise[-1, -1] += (1.0 - keep**2) * AIR.gust[0 if axis == "level" else 2] ** 2
    position, attitude, velocity = SafeSettings().seen
    sights = [position, velocity, attitude][: 3 if axis == "level" else 2]
    return step, told, noise, np.eye(n)[: len(sights)], np.diag(np.square(sights))


def left(axis: Axis, feedback: Feedback, truth: Loops, sights: float = 1.0, air: float = 1.0) -> tuple[float, float]:
    """Rms of the position [m] and of the command of who filters and decides by the books.

    Args:
        axis: level or up.
        feedback: of the state that is believed now, and of the two commands that are pending.
        truth: the loops.
        sights: by how much the noise of the looks is multiplied.
        air: the same of gusts and other noise.
    """
    books = SafeSettings().books.loops
    step, told, noise, seen, blur = chain(axis, books)
    spread = scipy.linalg.solve_discrete_are(step.T, seen.T, noise, blur)
    gain = spread @ seen.T @ np.linalg.inv(seen @ spread @ seen.T + blur)
    moves, _, shaken, _, _ = chain(axis, truth)
    late = truth.link - books.link  # of a tick, how long the command before acts
    assert 0.0 <= late < DT
    (_, before, _), (rest, after, _) = held(axis, truth, late), held(axis, truth, DT - late)
    n = SIZE[axis]
    # The state, what is believed of it before a look, and the commands of one, two and three ticks ago.
    whole, believed = np.zeros((2 * n + 3, 2 * n + 3)), np.zeros((n, 2 * n + 3))
    believed[:, :n], believed[:, n : 2 * n] = gain @ seen, np.eye(n) - gain @ seen
    decided = -feedback[0] @ believed
    decided[2 * n : 2 * n + 2] -= feedback[1:]
    whole[:n, :n], whole[:n, 2 * n + 2], whole[:n, 2 * n + 1] = moves, rest @ before, after
    whole[n : 2 * n] = step @ believed
    whole[n : 2 * n, 2 * n + 1] += told
    whole[2 * n] = decided
    whole[2 * n + 1, 2 * n] = whole[2 * n + 2, 2 * n + 1] = 1.0
    if np.abs(np.linalg.eigvals(whole)).max() > 0.9995:
        return 1.0, np.inf
    enters = np.zeros((2 * n + 3, len(seen)))
    enters[n : 2 * n], enters[2 * n] = step @ gain, -feedback[0] @ gain
    fresh = sights**2 * enters @ blur @ enters.T
    fresh[:n, :n] += air**2 * shaken
    found = scipy.linalg.solve_discrete_lyapunov(whole, fresh)
    return float(np.sqrt(found[0, 0])), float(np.sqrt(found[2 * n, 2 * n]))


def from_ahead(axis: Axis, gains: Array, ticks: int, gust_fades: bool) -> Feedback:
    """Feedback of the state so many ticks ahead as one of the state now and of what is pending; the last is held."""
    step, told, *_ = chain(axis, SafeSettings().books.loops)
    step = step.copy()
    step[-1, -1] = step[-1, -1] if gust_fades else 1.0
    reach = [gains @ np.linalg.matrix_power(step, k) for k in range(ticks + 1)]
    return reach[ticks], sum(float(row @ told) for row in reach[: ticks - 1]), float(reach[ticks - 1] @ told)


def flatness(level: Array, up: Array) -> dict[Axis, Feedback]:
    """Of gains (3,) of position, velocity and tilt, and (2,) of position and velocity."""
    stiff, damp, tilt = level.tolist()
    gains = tilt * np.array([stiff / GRAVITY, damp / GRAVITY, 1.0, 0.0, 0.0, 0.0])
    state, last, before = from_ahead("level", gains, AHEAD, gust_fades=False)
    state[-1] += tilt / GRAVITY
    lift = from_ahead("up", np.array([*up.tolist(), 0.0, 1.0]), AHEAD, gust_fades=False)
    return {"level": (state, last, before), "up": lift}


@cache
def nodes(axis: Axis) -> tuple[Array, Array, Array]:
    """Steps (N,), states at the ends of all steps by the first state (N, n, n), and by the controls (N, n, N)."""
    count = TRACKING.horizon
    steps = np.minimum(np.full(count, TRACKING.step), DT * TRACKING.growth ** np.arange(count))
    state, controls = np.eye(SIZE[axis]), np.zeros((SIZE[axis], count))
    by_state, by_controls = [], []
    for k, duration in enumerate(steps.tolist()):
        step, told, _ = held(axis, SafeSettings().books.loops, duration)
        step = step.copy()
        step[-1, -1] = np.exp(-duration / AIR.gust_time)
        state, controls = step @ state, step @ controls
        controls[:, k] += told
        by_state.append(state)
        by_controls.append(controls)
    return steps, np.array(by_state), np.array(by_controls)


def plan(weights: dict[str, float]) -> dict[Axis, Feedback]:
    """Of a plan with weights as in :class:`KeeperSettings`: the first control of a quadratic program without bounds."""
    found: dict[Axis, Feedback] = {}
    kinds: tuple[tuple[Axis, str], ...] = ("level", "rate"), ("up", "thrust")
    for axis, kind in kinds:
        steps, by_state, by_controls = nodes(axis)
        share, count = steps / TRACKING.step, len(steps)
        change = np.diff(np.eye(count), axis=0)
        curve = np.diag(share * weights[kind]) + weights[f"{kind}_change"] * change.T @ change
        curve[0, 0] += weights[f"{kind}_change"]
        slope = np.zeros((count, SIZE[axis] + 1))
        slope[0, -1] = -weights[f"{kind}_change"]
        for row, name in enumerate(("position", "velocity", "attitude")[: 3 if axis == "level" else 2]):
            weighed = (share * weights[name])[:, None] * by_controls[:, row]
            curve += by_controls[:, row].T @ weighed
            slope[:, :-1] += weighed.T @ by_state[:, row]
        first = np.linalg.solve(curve, slope)[0]
        state, last, before = from_ahead(axis, first[:-1], LATE, gust_fades=True)
        found[axis] = state, last + float(first[-1]), before
    return found


def regulator(axis: Axis, price: float) -> Feedback:
    """The linear-quadratic one of the position, with a price on the command; it knows what is pending."""
    step, told, *_ = chain(axis, SafeSettings().books.loops)
    n = SIZE[axis]
    whole, enters, weights = np.zeros((n + 2, n + 2)), np.eye(n + 2)[:, [n + 1]], np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n], whole[n, n + 1], weights[0, 0] = step, told, 1.0, 1.0
    value = scipy.linalg.solve_discrete_are(whole, enters, weights, np.array([[price]]))
    gains = np.linalg.solve(price + enters.T @ value @ enters, enters.T @ value @ whole)[0]
    return gains[:n], float(gains[n + 1]), float(gains[n])


def cheapest(axis: Axis, effort: float = EFFORT) -> Feedback:
    """The regulator whose command has the rms that is allowed."""
    low, high = -11.0, -3.0  # of the price's decimal logarithm
    for _ in range(20):
        middle = 0.5 * (low + high)
        dear = left(axis, regulator(axis, 10.0**middle), SafeSettings().books.loops)[1] > effort
        low, high = (middle, high) if dear else (low, middle)
    return regulator(axis, 10.0**high)


@dataclass(frozen=True)
class Left:
    """Distance from the path, rms [mm], and the greater rms of commands."""

    distance: float
    effort: float


def of(feedbacks: dict[Axis, Feedback], truth: Loops, sights: float = 1.0, air: float = 1.0) -> Left:
    """Twice level and once up."""
    level, up = (left(axis, feedbacks[axis], truth, sights, air) for axis in ("level", "up"))
    return Left(1e3 * float(np.sqrt(2.0 * level[0] ** 2 + up[0] ** 2)), max(level[1], up[1]))


def best(made: Callable[[Array], dict[Axis, Feedback]], start: Array, truth: Loops) -> dict[Axis, Feedback]:
    """Positive numbers near ``start`` that leave the least, with commands no greater than allowed."""

    def cost(logarithms: Array) -> float:
        found = of(made(np.exp(logarithms)), truth)
        return min(found.distance + max(0.0, found.effort - EFFORT), 1e6)

    begin = np.log(start)
    corners = np.vstack([begin, begin + 0.7 * np.eye(len(begin))])
    how = {"maxfev": EVALUATIONS, "xatol": 1e-2, "fatol": 1e-3, "initial_simplex": corners}
    return made(np.exp(minimize(cost, begin, method="Nelder-Mead", options=how).x))


def by_gains(gains: Array) -> dict[Axis, Feedback]:
    """Flatness with gains (5,)."""
    return flatness(gains[:3], gains[3:])


NAMES = ("velocity", "attitude", "rate", "thrust", "rate_change", "thrust_change")


def by_weights(weights: Array) -> dict[Axis, Feedback]:
    """A plan with weights (6,); that of the position stays."""
    return plan({"position": TRACKING.position, **dict(zip(NAMES, weights.tolist(), strict=True))})


def floor() -> str:
    """The table."""
    flies = SafeSettings()
    gains = np.array([TUNED.position[0], TUNED.velocity[0], TUNED.tilt, TUNED.position[1], TUNED.velocity[1]])
    weights = np.array([getattr(TRACKING, name) for name in NAMES])
    books, truth = flies.books.loops, flies.true_loops
    made: dict[str, Callable[[Loops], dict[Axis, Feedback]]] = {
        "flatness, as it flies": lambda loops: by_gains(gains),
        "plan, as it flies": lambda loops: by_weights(weights),
        "flatness, best gains": partial(best, by_gains, gains),
        "plan, best weights": partial(best, by_weights, weights),
    }
    lines = []
    for name, make in made.items():
        there, here = make(truth), make(books)
        parts = [of(there, truth, 1.0, 0.0), of(there, truth, 0.0, 1.0), of(there, truth), of(here, books)]
        lines.append([name, *(f"{part.distance:.2f}" for part in parts), f"{parts[2].effort:.1f}"])
    known: dict[Axis, Feedback] = {"level": cheapest("level"), "up": cheapest("up")}
    lines.append(["linear-quadratic, all known", "-", "-", "-", f"{of(known, books).distance:.2f}", f"{EFFORT:.1f}"])
    head = [
        "who", "noise of looks alone [mm rms]", "air alone", "both", "both, loops as in the books",
        "commands [rad/s, m/s^2 rms]",
    ]  # fmt: skip
    return table(head, lines)


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    command(__doc__).parse_args(arguments)
    print(floor())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
