"""A prepared graph as a layer of PyTorch and of JAX: values, slopes, batches, failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.layers import Layer
from unifg.models import unicycle
from unifg.solvers import InteriorPoint
from unifg.typing import Array

N = 6
GOALS = np.array([[0.9, 0.3], [0.7, -0.2], [0.8, 0.1]])
WEIGHTS = np.array([0.4, 0.5, 0.7])
STARTS = np.array([[0.0, 0.0, 3.1], [0.1, 0.0, -3.14159], [0.0, 0.2, 0.3]])


@pytest.fixture(scope="module")
def layer() -> Layer:
    """A drive whose start, goal and weight are data; the start's heading lies where angles wrap around."""
    return Layer(*arguments())


def arguments(limit: float = 4.0) -> tuple[Any, ...]:
    graph, x, u = graph_of(("x", fg.SE2, N + 1), ("u", fg.Rn(2), N))
    start, goal, weight = graph.data("start", STARTS[0]), graph.data("goal", GOALS[0]), graph.data("weight", 0.5)
    graph.fix(x[0], start, name="start")
    graph.minimize(lambda pose, to: pose[:, :2] - to, x[-1], goal, sigma=weight, name="arrive")
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=1.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.2, lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=-limit, upper=limit, name="limits")
    guess = {x: np.tile(STARTS[0], (N + 1, 1)), u: np.full((N, 2), 0.3)}
    return InteriorPoint(tolerance=1e-10).prepare(graph), [start, goal, weight], [x, u], guess


def wanted(x: Any, u: Any) -> Any:
    """A loss that has a slope along everything."""
    return (x[..., :, :2] ** 2).sum() + (0.1 + u[..., :, 1]).prod() + x[..., -1, 2].sum()


def slopes_of(x: Array, u: Array) -> tuple[Array, Array]:
    """Its slopes, for one instance."""
    by_x, by_u, factors = np.zeros_like(x), np.zeros_like(u), 0.1 + u[:, 1]
    by_x[:, :2], by_x[-1, 2] = 2.0 * x[:, :2], 1.0
    by_u[:, 1] = [np.prod(np.delete(factors, k)) for k in range(len(factors))]
    return by_x, by_u


def test_slopes_are_differences_of_problems_solved_again(layer: Layer) -> None:
    given = [STARTS[1], GOALS[1], WEIGHTS[1]]
    answers = layer.solve(*given)
    found = layer.pull(answers, slopes_of(*answers.values))
    for k, slope in enumerate(found):
        for at in np.ndindex(slope.shape):
            near = []
            for h in (1e-5, -1e-5):
                moved = [np.array(one, dtype=float) for one in given]
                moved[k][at] += h
                near.append(float(wanted(*layer.solve(*moved).values)))
            assert slope[at] == pytest.approx((near[0] - near[1]) / 2e-5, rel=1e-5, abs=1e-6)


def test_several_instances_share_what_is_given_once(layer: Layer) -> None:
    answers = layer.solve(STARTS, GOALS[0], WEIGHTS)
    alone = [layer.solve(STARTS[k], GOALS[0], WEIGHTS[k]) for k in range(3)]
    np.testing.assert_allclose(answers.values[0], [one.values[0] for one in alone], atol=1e-8)
    slopes = [slopes_of(*one.values) for one in alone]
    each = [layer.pull(one, slope) for one, slope in zip(alone, slopes, strict=True)]
    start, goal, weight = layer.pull(answers, [np.array(part) for part in zip(*slopes, strict=True)])
    np.testing.assert_allclose(start, [one[0] for one in each], rtol=1e-5)
    np.testing.assert_allclose(goal, np.sum([one[1] for one in each], axis=0), rtol=1e-5)
    np.testing.assert_allclose(weight, [one[2] for one in each], rtol=1e-5)


def test_what_is_repeated_along_an_axis_has_the_sum_of_its_slopes(layer: Layer) -> None:
    given = [STARTS, GOALS[:1], WEIGHTS[:1]]
    answers, whole = layer.solve(*given), layer.solve(STARTS, GOALS[0], WEIGHTS[0])
    np.testing.assert_array_equal(answers.values[0], whole.values[0])
    slopes = [np.ones_like(values) for values in answers.values]
    for one, found, right in zip(given, layer.pull(answers, slopes), layer.pull(whole, slopes), strict=True):
        assert found.shape == one.shape
        np.testing.assert_array_equal(np.squeeze(found), right)
    # whichever comes first
    first, second = (layer.solve(start, GOALS, 0.5).values[0] for start in (STARTS[:1], STARTS[0]))
    np.testing.assert_array_equal(first, second)


def test_slopes_along_the_length_of_a_quaternion_are_zero() -> None:
    graph = fg.Graph()
    q, seen = (
        graph.variables("q", fg.SO3, 2),
        graph.data("seen", fg.SO3.exp([[0.3, 0.2, 0.1], [3.0, 0.5, 0.2]]), each=True),
    )
    graph.minimize(fg.prior, q, seen, sigma=[1.0, 2.0, 3.0], name="seen")
    graph.minimize(fg.between, q[0], q[1], [0.0, 0.0, 0.0, 1.0], sigma=1.0, name="same")
    own = Layer(InteriorPoint(tolerance=1e-10).prepare(graph), [seen], [q], {q: seen.value})
    answers = own.solve(seen.value)
    slopes = np.random.default_rng(0).standard_normal((2, 4))
    (found,) = own.pull(answers, [slopes])
    np.testing.assert_allclose(np.einsum("ns,ns->n", found, seen.value), 0.0, atol=1e-9)
    h, tangent = 1e-5, np.random.default_rng(1).standard_normal((2, 3))
    ahead, behind = (own.solve(fg.SO3.retract(seen.value, s * h * tangent)).values[0] for s in (1.0, -1.0))
    moved = (fg.SO3.retract(seen.value, h * tangent) - fg.SO3.retract(seen.value, -h * tangent)) / (2.0 * h)
    assert (found * moved).sum() == pytest.approx((slopes * (ahead - behind)).sum() / (2.0 * h), rel=1e-6)


def test_an_instance_without_solution_raises_or_has_no_slope() -> None:
    prepared, inputs, outputs, guess = arguments(limit=0.01)
    graph = prepared.program.graph
    graph.constrain(lambda pose, to: pose[:, :2] - to, outputs[0][-1], inputs[1], lower=-0.1, upper=0.1, name="there")
    run = InteriorPoint(tolerance=1e-10).prepare(graph)
    goals = np.array([[0.02, 0.2], [0.9, 0.3]])
    with pytest.raises(fg.GraphError, match="instance 1 ended LOCALLY_INFEASIBLE"):
        Layer(run, inputs, outputs, guess).solve(STARTS[2], goals, 0.5)
    lenient = Layer(run, inputs, outputs, guess, failed="zero")
    answers = lenient.solve(STARTS[2], goals, 0.5)
    slopes = lenient.pull(answers, [np.ones_like(values) for values in answers.values])[1]
    assert np.abs(slopes[0]).max() > 0.0
    assert not slopes[1].any()


def test_shapes_are_named(layer: Layer) -> None:
    with pytest.raises(fg.GraphError, match=r"takes 3 inputs, found 2"):
        layer.solve(STARTS[0], GOALS[0])
    with pytest.raises(fg.GraphError, match=r"data 'goal' have shape \(3,\), expected \(2,\)"):
        layer.solve(STARTS[0], np.zeros(3), 0.5)
    with pytest.raises(fg.GraphError, match=r"layer: data 'goal' must be real numbers, found 'there'"):
        layer.solve(STARTS[0], "there", 0.5)
    answers = layer.solve(STARTS[0], GOALS[0], 0.5)
    for slopes in ([], answers.values[:1], [value[None] for value in answers.values], [1.0] * len(answers.values)):
        with pytest.raises(fg.GraphError, match="expected those of the outputs"):
            layer.pull(answers, slopes)  # type: ignore[arg-type]


def test_what_makes_no_layer_is_refused() -> None:
    prepared, inputs, outputs, guess = arguments()
    for changed, message in (
        ((prepared, inputs[0], outputs, guess), "inputs are a list of objects of the class Data"),
        ((prepared, ["goal"], outputs, guess), "inputs are a list of objects of the class Data"),
        ((prepared, inputs, ["x"], guess), "outputs are a list of objects of the class Family"),
    ):
        with pytest.raises(fg.GraphError, match=message):
            Layer(*changed)
    with pytest.raises(fg.GraphError, match="failed must be 'raise' or 'zero', found 'none'"):
        Layer(prepared, inputs, outputs, guess, failed="none")  # type: ignore[arg-type]


def test_what_is_given_twice_is_refused() -> None:
    """One of two slopes of an output would be lost, and two inputs of one datum would both have its slope."""
    prepared, inputs, outputs, guess = arguments()
    with pytest.raises(fg.GraphError, match="<Family x: 7 x SE2> is among the outputs twice"):
        Layer(prepared, inputs, [*outputs, outputs[0]], guess)
    with pytest.raises(fg.GraphError, match=r"<Data goal \(2,\)> is among the inputs twice"):
        Layer(prepared, [inputs[1], *inputs], outputs, guess)


def scaled() -> tuple[fg.Data, tuple[Any, ...]]:
    """A quotient, whose divisor is a datum that is no input; and the arguments of a layer."""
    graph, x = graph_with(fg.Rn(1), 1)
    seen, scale = graph.data("seen", [2.0]), graph.data("scale", [4.0])
    graph.minimize(lambda p, s, z: s * p - z, x, scale, seen, name="seen")
    graph.bound(x, lower=-9.0, upper=9.0)
    return scale, (InteriorPoint(tolerance=1e-10).prepare(graph), [seen], [x], {x: [[0.1]]})


def test_slopes_are_those_of_the_other_data_that_an_answer_was_found_with() -> None:
    scale, given = scaled()
    own = Layer(*given)
    answers = own.solve([2.0])
    scale.value = np.array([8.0])
    assert own.pull(answers, [np.ones((1, 1))])[0] == pytest.approx(0.25)
    assert own.solve([2.0]).values[0] == pytest.approx(0.25) and answers.batch.solution(0).cost < 1e-12


def test_other_data_that_have_changed_change_answers_of_jax() -> None:
    pytest.importorskip("jax", reason="the extra 'jax' is not installed")
    from unifg.jax import layer

    scale, given = scaled()
    solve = layer(*given)
    assert solve(np.array([2.0])).item() == pytest.approx(0.5)
    scale.value = np.array([8.0])
    assert solve(np.array([2.0])).item() == pytest.approx(0.25)


def _torch() -> tuple[Callable[..., Any], Callable[..., Any]]:
    torch = pytest.importorskip("torch", reason="the extra 'torch' is not installed")
    from unifg.torch import Layer as Module

    module = Module(*arguments())

    def slopes(loss: Callable[..., Any], *given: Array) -> list[Array]:
        tensors = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in given]
        loss(*module(*tensors)).backward()
        return [tensor.grad.numpy() for tensor in tensors]

    return module, slopes


def _jax() -> tuple[Callable[..., Any], Callable[..., Any]]:
    jax = pytest.importorskip("jax", reason="the extra 'jax' is not installed")
    from unifg.jax import layer

    jax.config.update("jax_enable_x64", True)
    solve = layer(*arguments())

    def slopes(loss: Callable[..., Any], *given: Array) -> list[Array]:
        by = jax.jit(jax.grad(lambda *arrays: loss(*solve(*arrays)), argnums=tuple(range(len(given)))))
        return [np.asarray(slope) for slope in by(*map(jax.numpy.asarray, given))]

    return solve, slopes


@pytest.mark.parametrize("framework", [_torch, _jax])
def test_frameworks_take_slopes_back(framework: Callable[[], Any], layer: Layer) -> None:
    _, slopes = framework()
    answers = layer.solve(STARTS[1], GOALS[1], WEIGHTS[1])
    expected = layer.pull(answers, slopes_of(*answers.values))
    for found, right in zip(slopes(wanted, STARTS[1], GOALS[1], WEIGHTS[1]), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-6)


@pytest.mark.parametrize("framework", [_torch, _jax])
def test_whole_numbers_are_no_type_of_answers(framework: Callable[[], Any], layer: Layer) -> None:
    module, _ = framework()
    whole = pytest.importorskip("torch").tensor if framework is _torch else pytest.importorskip("jax.numpy").array
    found = module(whole([0, 0, 3]), GOALS[0], 0.5)
    for values, right in zip(found, layer.solve([0.0, 0.0, 3.0], GOALS[0], 0.5).values, strict=True):
        np.testing.assert_allclose(values, right, atol=1e-9)


def test_second_derivatives_of_torch_raise_and_short_numbers_serve() -> None:
    torch = pytest.importorskip("torch", reason="the extra 'torch' is not installed")
    module, _ = _torch()
    weight = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    loss = module(STARTS[0], GOALS[0], weight)[0].square().sum() + weight**3
    (slope,) = torch.autograd.grad(loss, weight, create_graph=True)
    with pytest.raises(fg.GraphError, match="first derivatives only"):
        torch.autograd.grad(slope, weight)
    start = torch.tensor(STARTS[1], dtype=torch.bfloat16, requires_grad=True)
    poses = module(start, GOALS[0], 0.5)[0]
    poses.sum().backward()
    assert poses.dtype == start.grad.dtype == torch.bfloat16
    with pytest.raises(fg.GraphError, match="must be real numbers"):
        module(torch.tensor(STARTS[0], dtype=torch.complex64), GOALS[0], 0.5)


def test_a_training_loop_of_torch_falls() -> None:
    torch = pytest.importorskip("torch", reason="the extra 'torch' is not installed")
    module, _ = _torch()
    log_weight = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    starts, goals = torch.tensor(STARTS), torch.tensor(GOALS)
    optimizer, losses = torch.optim.Adam([log_weight], lr=0.2), []
    for _ in range(12):
        losses.append(loss := ((module(starts, goals, log_weight.exp())[0][:, -1, :2] - goals) ** 2).sum())
        optimizer.zero_grad(), loss.backward(), optimizer.step()
    assert losses[-1].item() < 0.2 * losses[0].item()


def test_a_training_loop_of_jax_falls_and_vmap_is_a_batch() -> None:
    jax = pytest.importorskip("jax", reason="the extra 'jax' is not installed")
    solve, _ = _jax()

    def loss(log_weight: Any) -> Any:
        return ((solve(STARTS, GOALS, jax.numpy.exp(log_weight))[0][:, -1, :2] - GOALS) ** 2).sum()

    log_weight, step = 0.5, jax.jit(jax.value_and_grad(loss))
    first = float(step(log_weight)[0])
    for _ in range(12):
        log_weight -= 2.0 * step(log_weight)[1]
    assert float(step(log_weight)[0]) < 0.2 * first
    mapped = jax.vmap(lambda start, goal: solve(start, goal, 0.5)[0])(STARTS, GOALS)
    np.testing.assert_allclose(mapped, solve(STARTS, GOALS, np.full(3, 0.5))[0], atol=1e-8)


def test_vmap_over_what_instances_share_is_a_loop() -> None:
    """The axis of vmap stands in front of the instances, not in their place."""
    jax = pytest.importorskip("jax", reason="the extra 'jax' is not installed")
    solve, _ = _jax()

    def total(weight: Any) -> Any:
        return (solve(STARTS, GOALS, weight)[0] ** 2).sum()

    slopes = jax.vmap(jax.value_and_grad(total))(WEIGHTS)
    for k, weight in enumerate(WEIGHTS):
        for many, one in zip(slopes, jax.value_and_grad(total)(weight), strict=True):
            np.testing.assert_allclose(many[k], one, rtol=1e-6)
    with pytest.raises(fg.GraphError, match=r"data 'goal' have shape \(3,\), expected \(2,\)"):
        solve(STARTS[0], np.zeros(3), 0.5)


def test_short_numbers_serve_jax_and_complex_ones_are_refused() -> None:
    """Slopes of bfloat16 were no real numbers; of complex data the imaginary part was dropped."""
    jax = pytest.importorskip("jax", reason="the extra 'jax' is not installed")
    solve, _ = _jax()
    start = jax.numpy.asarray(STARTS[1], dtype=jax.numpy.bfloat16)
    slope = jax.grad(lambda numbers: solve(numbers, GOALS[0], 0.5)[0].sum())(start)
    assert slope.dtype == jax.numpy.bfloat16 and bool(slope.any())
    with pytest.raises(fg.GraphError, match="must be real numbers, found complex"):
        solve(STARTS[0], GOALS[0] * 1j, 0.5)
