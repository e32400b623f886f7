"""Windows and loops that are handed what nobody should hand them, and episodes that follow one another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from test_horizon import ticks
from unifg.horizon import (
    Constant,
    Context,
    ControlCost,
    Dynamics,
    InitialGuesses,
    LastPlanThenBrake,
    Measurement,
    Plan,
    RecedingHorizon,
    Robot,
    Term,
    Tree,
    Window,
)
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array, ArrayLike

H, A, B = 0.5, np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.125], [0.5]])
POINT = Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: A @ x + B @ u)


def moved(x: Array, u: Array, y: Array, h: float) -> Array:
    return np.asarray(y - x @ A.T - u @ B.T)


def position(x: Array, z: Array) -> Array:
    return x[:, :1] - z


def window_of(*terms: Term, length: int = 3, robot: Robot = POINT, **options: Any) -> Window:
    usual: dict[str, Any] = {"start": [0.0, 0.0], "sigma": [1.0, 0.5], "solver": GaussNewton(tolerance=1e-12)}
    motion = Dynamics(moved, H, sigma=[0.05, 0.1])
    return Window(robot, length, [motion, *(terms or (Measurement("p", position, (1,), 0.3),))], **usual | options)


@dataclass
class Wish:
    """To be somewhere with some control, of which more than a little does not count more."""

    loss: Any = None

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        goal = graph.data("goal", np.zeros(2))
        graph.minimize(fg.prior, x[1:], goal, sigma=1.0, name="goal")
        graph.minimize(fg.prior, u, [5.0], sigma=1.0, robust=self.loss, name="wish")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {} if now.given is None else {"goal": now.given}


def loop_of(*terms: Term, solver: fg.Solver | None = None, **options: Any) -> RecedingHorizon:
    usual: dict[str, Any] = {"window": window_of()}
    ahead: list[Term] = [Dynamics(moved, H), *(terms or (Wish(), ControlCost([1.0])))]
    return RecedingHorizon(POINT, 4, ahead, solver=solver or InteriorPoint(tolerance=1e-9), **usual | options)


# ---------------------------------------------------------------- one episode after another


@dataclass
class Buffer:
    """A sensor that keeps what has come in until it is asked."""

    name: str
    waiting: list[float] = field(default_factory=list)
    begun: int = 0

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(position, x[-1], graph.data(self.name, np.zeros(1)), sigma=0.3, name=f"{self.name} here")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {self.name: [np.mean(self.waiting or [0.0])]}

    def reset(self) -> None:
        self.waiting.clear()
        self.begun += 1


@pytest.mark.parametrize("given", [None, [0.0, 0.0]])
def test_terms_forget_the_last_episode_with_the_window(given: Any) -> None:
    behind, ahead, found = Buffer("seen"), Buffer("told"), []
    loop = loop_of(Wish(), ahead, window=window_of(behind))
    for value in (100.0, 0.0):
        behind.waiting.append(value)
        ahead.waiting.append(value)
        found.append(loop.tick().controls)
        loop.reset(given)
    assert (behind.begun, ahead.begun) == (2, 2)
    fresh = loop_of(Wish(), Buffer("told"), window=window_of(Buffer("seen"))).tick().controls
    np.testing.assert_allclose(found[1], fresh, atol=1e-9)
    window = window_of(both := Buffer("seen"))
    window.reset()
    assert both.begun == 1
    shared = Buffer("seen")
    loop_of(Wish(), shared, window=window_of(shared)).reset()
    assert shared.begun == 1  # once, though it is a term of both


@pytest.mark.parametrize("late", [False, True], ids=["before the estimate", "after it"])
@pytest.mark.parametrize("place", [0, 2, 3])
def test_what_is_recorded_after_the_estimate_leaves_with_its_node(place: int, late: bool) -> None:
    found = []
    for after in (late, False):
        window = window_of(length=3)
        for k in ticks(window, 5, 0.1):
            if k == 4 and not after:
                window.record("p", [10.0], place)
        if after:
            window.record("p", [10.0], place)
        for _ in range(3):
            window.move([0.0])
            window.estimate()
        found.append((window.present, window.covariance))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-9)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-9)


# ---------------------------------------------------------------- weights


@pytest.mark.product(2)
@pytest.mark.parametrize(
    "loss",
    [
        None,
        fg.Huber(1.0),
        fg.Cauchy(1.5),
        fg.Tukey(6.0),
        fg.DCS(2.0),
        fg.GemanMcClure(3.0),
        fg.TruncatedLeastSquares(2.0),
        fg.Reweighted(lambda s: 1.0 / (1.0 + s)),
    ],
    ids=lambda loss: type(loss).__name__,
)
def test_a_common_factor_changes_no_plan(loss: Any) -> None:
    """Every cost is multiplied by it, beyond the bend of its loss, too."""
    found, costs = [], []
    for weight in (1.0, 16.0):
        solver = SQP(tolerance=1e-10, hessian="gauss-newton", max_iterations=200)
        loop = loop_of(Wish(loss), ControlCost([0.7]), control_weight=weight, solver=solver, window=None)
        found.append(loop.plan([1.0, 0.5]).controls)
        assert loop.solution is not None
        costs.append(loop.solution.cost)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    assert costs[1] == pytest.approx(16.0 * costs[0], rel=1e-6)


@dataclass
class Rail(Term):
    """A limit of the state that gives way."""

    price: Any

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        price = graph.data("price", 1.0) if self.price is None else self.price
        graph.bound(x, lower=[-0.2, -0.1], upper=[1.5, 0.4], soft=price, name="rail")


@pytest.mark.parametrize("price", [0.3, fg.Soft(linear=[0.3, 0.1], quadratic=2.0)])
def test_a_common_factor_is_one_of_soft_constraints_too(price: Any) -> None:
    found = []
    for weight in (1.0, 16.0):
        loop = loop_of(Wish(), ControlCost([0.7]), Rail(price), control_weight=weight, window=None)
        found.append(loop.plan([1.0, 0.5]).controls)
        assert loop.solution is not None and loop.solution.converged and loop.solution.slack("rail").max() > 0.1
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)
    with pytest.raises(fg.GraphError, match=r"'rail' cannot be weighed"):
        loop_of(Rail(None), control_weight=16.0)


class Own(fg.Huber):
    """A loss of somebody's own."""

    def value(self, squared: Array) -> Array:
        return squared


def test_a_loss_that_nobody_knows_is_not_weighed() -> None:
    loop_of(Wish(Own(1.0)), control_weight=1.0)
    with pytest.raises(fg.GraphError, match=r"'wish'.*loss Own.*control_weight"):
        loop_of(Wish(Own(1.0)), control_weight=2.0)


# ---------------------------------------------------------------- limits


@pytest.mark.parametrize(
    "limits",
    [
        ([np.nan], [1.0]),
        ([-1.0], [np.nan]),
        ([1.0], [-1.0]),
        ([-1.0, -1.0], [1.0, 1.0]),
        ([np.inf], [np.inf]),
        ([-np.inf], [-np.inf]),
        ([-1.0],),
        ("low", "high"),
        5.0,
    ],
    ids=str,
)
def test_limits_are_looked_at_where_they_are_given(limits: Any) -> None:
    with pytest.raises(fg.GraphError, match=r"limits.*\(1,\)"):
        loop_of(limits=limits)


@pytest.mark.parametrize("limits", [(-0.1, 0.1), ([-0.1], np.inf), ([-np.inf], [0.1])], ids=str)
def test_limits_of_one_number_hold_for_all(limits: Any) -> None:
    plan = loop_of(limits=limits).tick()
    assert plan.controls.max() <= limits[1] and plan.controls.min() >= limits[0]
    assert plan.controls.shape == (4, 1)


# ---------------------------------------------------------------- what does not fit


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"gian": [[0.1]]}, r"no static 'gian' \(there are: gain\)"),
        ({"gain": [[0.1], [0.2]]}, r"'gain' has shape \(2, 1\), expected \(1, 1\)"),
        ({"gain": [[np.nan]]}, "'gain' must be finite numbers"),
    ],
)
def test_a_plan_is_given_statics_that_there_are(constants: Any, message: str) -> None:
    robot = Robot(fg.Rn(2), fg.Rn(1), (fg.horizon.Constant("gain", fg.Rn(1), [0.0], 1.0),), predict=POINT.predict)
    loop: RecedingHorizon = RecedingHorizon(robot, 3, [Dynamics(moved, H), Wish()], solver=SQP())
    loop.plan([0.0, 0.0], constants={"gain": np.array([[0.1]])})
    with pytest.raises(fg.GraphError, match=message):
        loop.plan([0.0, 0.0], constants=constants)


BAD_SIGMAS: list[Any] = [-1.0, [1.0, -1.0], 0.0, np.nan, np.inf, [1.0, 1.0, 1.0], [[1.0, 0.5], [0.0, 1.0]], np.eye(3)]


@pytest.mark.parametrize("sigma", BAD_SIGMAS, ids=str)
def test_a_belief_has_positive_deviations(sigma: Any) -> None:
    with pytest.raises(fg.GraphError, match="at the start must be"):
        window_of(sigma=sigma)
    window = window_of()
    window.record("p", [1.0])
    window.estimate()
    before = window.present
    with pytest.raises(fg.GraphError, match="at the start must be"):
        window.reset([2.0, 0.0], sigma)
    np.testing.assert_array_equal(window.present, before)


@pytest.mark.parametrize("start", [[np.nan, 0.0], [0.0], "here", [[0.0, 0.0]]], ids=str)
def test_a_new_beginning_is_looked_at(start: Any) -> None:
    sensor = Buffer("seen", [1.0])
    loop = loop_of(window=window_of(sensor))
    plan = loop.tick()
    with pytest.raises(fg.GraphError, match="the start"):
        loop.reset(start)
    assert sensor.waiting and np.array_equal(loop.applied, plan.control) and loop.kept.age == 0
    circle = Robot(fg.SO3, fg.Rn(1))
    prior: Measurement = Measurement("p", fg.prior, (4,), 0.1)
    window: Window = Window(circle, 2, [prior], start=[0.0, 0.0, 0.0, 1.0], sigma=0.1)
    with pytest.raises(fg.GraphError, match="the start"):
        window.reset(np.zeros(4))
    with pytest.raises(fg.GraphError, match=r"the new node.*SO3"):
        window.move([0.0], state=np.zeros(4))


@pytest.mark.parametrize(
    "guess",
    [{"state": np.zeros(7)}, {"state": [np.nan, 0.0]}, {"steps": {"w": [1.0]}}, {"control": ["fast"]}],
    ids=str,
)
def test_a_node_that_does_not_fit_does_not_enter(guess: Any) -> None:
    window = window_of()
    window.estimate()
    with pytest.raises(fg.GraphError):
        window.move(**{"control": [0.0]} | guess)
    assert window.history.entered == 0


@pytest.mark.parametrize("wrong", [[np.nan, 0.0], [0.0, 0.0, 0.0]], ids=str)
def test_a_model_that_leads_nowhere_is_named(wrong: Any) -> None:
    window = window_of(robot=Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: np.array(wrong)))
    window.estimate()
    with pytest.raises(fg.GraphError, match=r"predict.*\(2,\)"):
        window.move([0.0])
    assert window.history.entered == 0


def test_a_measurement_that_is_taken_back_was_none() -> None:
    found = []
    for taken in (False, True):
        window = window_of()
        for k in range(6):
            if k:
                window.move([0.0])
            if taken and k == 4:
                window.record("p", [10.0])
            window.estimate()
            if taken and k == 5:
                window.record("p", [np.nan], -2)
                window.estimate()
        found.append(window.present)
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


@pytest.mark.product(6)
@pytest.mark.parametrize(
    "wrong",
    [
        {"time": np.nan},
        {"time": np.inf},
        {"time": "now"},
        {"applied": [0.0, 0.0]},
        {"applied": [np.nan]},
        {"measured": {"p": np.zeros(2)}},
        {"measured": {"p": ["here"]}},
        {"measured": {"sonar": np.zeros(1)}},
        {"measured": {"p": [0.2], "sonar": [0.1]}},
    ],
    ids=str,
)
@pytest.mark.parametrize("before", [0, 2])
def test_a_first_tick_refuses_what_later_ones_refuse(before: int, wrong: dict[str, Any]) -> None:
    loop, fresh = loop_of(), loop_of()
    for k in range(before):
        loop.tick(time=float(k))
        fresh.tick(time=float(k))
    with pytest.raises(fg.GraphError):
        loop.tick(**{"measured": {"p": [1.0]}} | wrong)
    plan, again = (own.tick(measured={"p": [1.0]}, time=5.0) for own in (loop, fresh))
    np.testing.assert_array_equal(plan.controls, again.controls)


def test_a_quaternion_that_is_none_is_refused_before_anything_moves() -> None:
    """An attitude sensor that begins with zeros: in the window they would stop every later tick."""
    robot, still = Robot(fg.SO3, fg.Rn(3)), fg.SO3.identity()
    turn = Dynamics(lambda x, u, y, h: fg.SO3.local(fg.SO3.compose(x, fg.SO3.exp(h * u)), y), 0.1, sigma=0.1)
    window = Window(robot, 3, [turn, Measurement("attitude", fg.prior, (4,), 0.1)], start=still, sigma=1.0)
    loop = RecedingHorizon(robot, 2, [turn, ControlCost(sigma=1.0)], solver=InteriorPoint(), window=window)
    for attitude in 5 * [still]:
        loop.tick(measured={"attitude": attitude})
    with pytest.raises(fg.GraphError, match=r"measurement 'attitude'.*not on SO3"):
        loop.tick(measured={"attitude": np.zeros(4)})
    assert window.history.times[-1] == pytest.approx(0.4)
    for attitude in (np.full(4, np.nan), 1.0001 * still):
        loop.tick(measured={"attitude": attitude})
    assert window.history.recorded("attitude")[1].tolist() == [True, True, False, True]


class Fence:
    """A soft limit whose price changes with every tick."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.bound(x, upper=[1.0, np.inf], soft=graph.data("price", 1.0), name="fence")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"price": now.given}


def test_prices_of_soft_constraints_are_data_of_terms() -> None:
    loop = loop_of(Fence())
    for price in (0.5, 0.01, 0.3):
        loop.plan([1.5, 0.0], given=price)
        assert loop.solution is not None and loop.solution.converged
        np.testing.assert_allclose(np.abs(loop.solution.dual("fence")).max(), price, rtol=1e-4)


NO_NUMBERS: dict[str, tuple[Any, str]] = {
    "a masked measurement": (lambda: window_of().record("p", np.ma.array([1.0], mask=[True])), "'p'.*masked"),
    "a date measured": (lambda: window_of().record("p", np.array(["2020"], "M8[D]")), "'p'.*dates"),
    "solver of a window": (lambda: window_of(solver=3), "Window: solver must be of the class Solver or None, found 3"),
    "robot of a window": (lambda: window_of(robot=3), "Window: robot must be of the class Robot, found 3"),  # type: ignore[arg-type]
    "sigma of a window": (lambda: window_of(sigma="x"), "the standard deviations at the start must be real numbers"),
    "rounds": (lambda: window_of(rounds=0), "one round"),
    "length": (lambda: window_of(length=2.5), "length=2.5"),  # type: ignore[arg-type]
    "prediction": (lambda: window_of(robot=Robot(fg.Rn(2), fg.Rn(1), predict=lambda x, u: "x")).move([0.0]), "predict"),  # type: ignore[arg-type,return-value]
    "start": (lambda: Constant("b", fg.Rn(1), "x", 1.0), "'b'.*start"),
    "steps": (lambda: RecedingHorizon(POINT, 2.5, [Wish()], solver=SQP()), "steps=2.5"),  # type: ignore[arg-type]
    "solver": (lambda: loop_of(solver=SQP), "solver must be of the class Solver.*a class: give an object"),  # type: ignore[arg-type]
    "deadline": (lambda: loop_of(deadline="a"), "deadline must be a number, found 'a'"),
    "delay": (lambda: loop_of(delay=1.5), "delay must be a whole number, found 1.5"),
    "clock": (lambda: loop_of(clock=3), "clock must be a function, found 3"),
    "probabilities": (lambda: loop_of(probabilities=[1.0]), r"probabilities must be a function or None, found \[1.0\]"),
    "patience": (lambda: loop_of(patience=None), "patience must be a whole number"),
    "no patience": (lambda: loop_of(patience=-1), "patience=-1: one tick or more"),
    "no times": (
        lambda: RecedingHorizon(POINT, 2, [Wish(), Dynamics(moved)], solver=SQP()),
        "term 'dynamics' has no step, and the horizon no node times: give Dynamics its step",
    ),
    "a model without seconds": (
        lambda: replace(POINT, tick=H),
        r"predict is called as predict\(x, u, seconds\), .* too many positional",
    ),
    "a model with seconds": (
        lambda: replace(POINT, predict=lambda x, u, h: x),
        r"predict is called as predict\(x, u\), .*'h'",
    ),
    "a model": (lambda: replace(POINT, predict=3), "Robot: predict must be a function or None, found 3"),  # type: ignore[arg-type]
    "tick": (lambda: replace(POINT, tick=0.0), "Robot: tick must be positive, found 0.0"),
    "constants": (lambda: replace(POINT, constants={"a": 1}), "the robot's constants are a tuple"),  # type: ignore[arg-type]
    "a step back": (lambda: Dynamics(moved, -H), "term 'dynamics': its step must be positive .s., found -0.5"),
    "a step of words": (lambda: Dynamics(moved, "long"), "step must be real numbers, found 'long'"),
    "node": (lambda: window_of().record("p", [1.0], node=1.5), "'p' of node 1.5: a whole number"),  # type: ignore[arg-type]
    "measured": (lambda: loop_of().tick(measured=[1.0]), r"measured: values by name are expected, found \[1.0\]"),  # type: ignore[arg-type]
    "data of a term": (lambda: giving(None), "Giving.data must return values by name, found None"),
    "a function of a guess": (lambda: InitialGuesses(cold=3), "cold must be a function or None, found 3"),  # type: ignore[arg-type]
    "no more guesses": (
        lambda: loop_of(starts=InitialGuesses(others=lambda now: None)).plan([0.0, 0.0]),  # type: ignore[arg-type,return-value]
        r"InitialGuesses: others\(now\) must be of the class Iterable, found None",
    ),
    "sigmas without a limit": (lambda: loop_of(sigmas="a"), "sigmas of all limits must be real numbers, found 'a'"),
    "half a guess": (lambda: guessing((np.zeros((5, 2)),)), "an initial guess is two arrays, states and controls"),
    "a carried guess": (lambda: carrying(None), "a guess is .family: array"),
    "judge": (
        lambda: loop_of(judge=lambda *given: None).plan([0.0, 0.0]),
        "judge: must return a Decision, found None",
    ),
    "brake": (lambda: LastPlanThenBrake(POINT, brake=3), "brake must be a function or None, found 3"),  # type: ignore[arg-type]
    "braking of another shape": (
        lambda: braking([1.0, 2.0]),
        r"the controls that brake gives has shape \(2,\), expected \(4, 1\)",
    ),
    "braking by what is not finite": (lambda: braking(np.nan), "the controls that brake gives must be finite"),
    "braking by words": (lambda: braking("hard"), "the controls that brake gives must be real numbers, found 'hard'"),
    "starts": (lambda: loop_of(starts=lambda now: ()), "starts must be of the class InitialGuesses or None"),
    "terms": (lambda: RecedingHorizon(POINT, 2, Wish(), solver=SQP()), "terms are a list"),  # type: ignore[arg-type]
    "tree": (lambda: Tree("ab"), "a tree is made of whole numbers.*found 'ab'"),  # type: ignore[arg-type]
    "tails": (lambda: Tree.branched(1, [1.5]), "tails=1.5"),  # type: ignore[list-item]
    "one tail": (lambda: Tree.branched(1, 3), "the tails of a tree are a list"),  # type: ignore[arg-type]
    "probabilities of tails": (
        lambda: Tree.branched(1, (1, 1)).probabilities("ab"),
        "the probabilities of the tails must be",
    ),
    "present": (lambda: loop_of().plan("x"), "present"),
    "present of another shape": (lambda: loop_of().plan([[0.0, 0.0]]), "present"),
    "times": (lambda: loop_of().set_times("x"), "times"),
    "wanted": (lambda: loop_of(ControlCost([1.0], wanted=[1.0, 2.0, 3.0])), "wanted"),
    "guess": (lambda: guessing((np.zeros((3, 2)), np.zeros((4, 1)))), r"states of a guess.*\(3, 2\).*\(5, 2\)"),
    "guess of controls": (lambda: guessing((np.zeros((5, 2)), np.zeros((4, 2)))), "controls of a guess"),
}


def guessing(guess: Any) -> None:
    loop_of(starts=InitialGuesses(cold=lambda now: guess)).plan([0.0, 0.0])


def carrying(guess: Any) -> None:
    loop = loop_of(starts=InitialGuesses(carry=lambda shifted, now: guess))
    loop.plan([0.0, 0.0])
    loop.plan([0.0, 0.0])


@dataclass
class Giving:
    """A term with something for data."""

    given: Any

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x, [0.0, 0.0], name="rest")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return self.given  # type: ignore[no-any-return]


def giving(given: Any) -> None:
    loop_of(Giving(given)).plan([0.0, 0.0])


def braking(brake: Any) -> Plan:
    return loop_of(judge=LastPlanThenBrake(POINT, feasible=-1.0, brake=lambda now: brake)).plan([0.0, 0.0])


@pytest.mark.parametrize("brake", [0.5, [0.5], np.full((4, 1), 0.5)])
def test_a_loop_brakes_by_one_control_or_by_all(brake: Any) -> None:
    plan = braking(brake)
    assert plan.source == "braking" and (plan.controls == 0.5).all()


class Log:
    """A cost that is finite on one side of where the caller says."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        side = graph.data("side", np.zeros(1))
        graph.minimize(lambda x, s: np.log(x[:, :1] - s), x, side, name="log")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"side": [now.given]}


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_warm_start_where_a_term_is_not_finite_gives_way_to_a_fresh_guess() -> None:
    loop = loop_of(Log(), ControlCost([1.0]))
    loop.plan([2.0, 0.0], 0.0)
    warm = loop.guess
    with pytest.raises(fg.GraphError, match="not finite at the guess"):
        loop.plan([2.0, 0.0], 5.0)  # no guess from there is
    assert loop.guess is warm and warm is not None
    fresh = loop_of(Log(), ControlCost([1.0]))
    np.testing.assert_array_equal(loop.plan([7.0, 0.0], 5.0).states, fresh.plan([7.0, 0.0], 5.0).states)


@pytest.mark.parametrize(("make", "message"), NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_what_is_no_number_is_refused_by_name(make: Any, message: str) -> None:
    with pytest.raises(fg.GraphError, match=message):
        make()


class Mute:
    """A term that forgot to give its data."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x, [0.0, 0.0], name="rest")


def test_terms_are_looked_at_before_they_are_stated() -> None:
    for term in (
        Dynamics(moved, H, sigma=1.0, constants=("b",)),
        Measurement("p", position, (1,), 0.3, constants=("b",)),
    ):
        with pytest.raises(fg.GraphError, match=rf"'{term.name}'.*'b'"):
            window_of(term)
    for shape in (2, "ab", (1.5,), (-1,)):
        with pytest.raises(fg.GraphError, match=r"'p'.*shape.*\(2,\)"):
            Measurement("p", position, shape, 0.3)  # type: ignore[arg-type]
    mute: Any = Mute()
    for make in (lambda: window_of(mute), lambda: loop_of(mute), lambda: window_of(Wish)):  # type: ignore[arg-type]
        with pytest.raises(fg.GraphError, match=r"(Mute|Wish).*state.*data"):
            make()


class Speed:
    """A speed that was measured over the last step but one, by its duration."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        duration = graph.data("duration", np.ones(1), each=True)
        graph.minimize(lambda x, y, h: (y[:, :1] - x[:, :1]) / h[:, None], x[-3], x[-2], duration, name="speed")

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"duration": np.diff(now.past.times)[-2:-1]}


def test_a_term_that_divides_by_durations_is_told_of_those_that_are_none() -> None:
    with pytest.raises(fg.GraphError, match=r"filled=False"):
        place: list[Term] = [Measurement("p", position, (1,), 0.3), Speed()]
        Window(POINT, 3, place, start=[0.0, 0.0], sigma=1.0, solver=GaussNewton(), filled=True).estimate()
    window = window_of(Speed())
    for k in range(6):
        if k:
            window.move([0.1])
        window.estimate()
    with pytest.raises(fg.GraphError) as error:
        window_of(Wrong(), filled=False).estimate()
    assert "filled" not in str(error.value)


class Wrong(Speed):
    """The same, with data that nobody reads."""

    def data(self, now: Context[Any]) -> Mapping[str, ArrayLike]:
        return {"durations": [1.0]}


def test_a_constant_keeps_what_it_was_stated_with() -> None:
    start, sigma = np.array([[1.0, 2.0]]), np.array([0.5, 0.1])
    mark = Constant("mark", fg.Rn(2), start, sigma)
    start[:], sigma[:] = 9.0, 9.0
    np.testing.assert_array_equal(mark.values, [[1.0, 2.0]])
    np.testing.assert_allclose(mark.information[0], np.diag([4.0, 100.0]))
