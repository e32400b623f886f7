"""Windows, marginal priors, and the graph that localises and drives at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import maps
import unifg as fg
from problems.graphs import graph_with
from unifg.models import lidar
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.ground.drive_past import WINDOW, Registration, Smoother
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import Episode, NavigationSettings, run_navigation
from unifg.solvers import GaussNewton
from unifg.typing import Array

HERE, THERE = (13.9, 20.0, -1.6), (15.0, 14.0, 0.0)


@pytest.fixture(scope="module")
def field() -> DistanceMap:
    return maps.building()[1]


def chain(count: int, rng: np.random.Generator) -> tuple[fg.Graph, fg.Family, Array]:
    """A linear chain: prior on the first, noisy steps, a fix on position now and then."""
    graph, x = graph_with(fg.Rn(2), count)
    graph.minimize(fg.prior, x[0], [0.3, -0.2], sigma=0.5, name="prior")
    steps = rng.normal(size=(count - 1, 2))
    graph.minimize(lambda a, b, z: b - a - z, x[:-1], x[1:], steps, sigma=[0.1, 0.2], name="step")
    fixes = rng.normal(size=(count, 2))
    graph.minimize(fg.prior, x, fixes, sigma=0.7, name="gps")
    return graph, x, steps


def test_marginal_prior_refuses_what_it_cannot_do(rng: np.random.Generator) -> None:
    graph, x, _ = chain(4, rng)
    solution = GaussNewton().solve(graph, {x: np.zeros((4, 2))})
    with pytest.raises(fg.GraphError, match=r"also depend on x\[2\]"):
        solution.marginal_prior(["step", "gps"], x[1], x[0])
    with pytest.raises(fg.GraphError, match="no cost is called 'steps'"):
        solution.marginal_prior(["steps"], x[0], x[1])


def settled(weight: float, ticks: int = 12) -> tuple[Episode, Smoother]:
    """A joint episode after some ticks, and its past."""
    settings = NavigationSettings(
        start=HERE,
        goals=(THERE,),
        coupling="joint",
        seed=3,
        controller=replace(ControllerSettings(), control_weight=weight),
    )
    episode = Episode(settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode, "_arrived", lambda goal: False)
        episode.run(maps.stop_after(ticks))
    smoother = episode.pilot.estimator
    assert isinstance(smoother, Smoother)
    return episode, smoother


@pytest.fixture(scope="module")
def past() -> Smoother:
    """Past of a joint episode of the usual weight, to be looked at."""
    return settled(1.0)[1]


def test_the_past_ignores_a_weightless_future() -> None:
    """With a tiny control weight the joint estimate is that of the window alone."""
    episode, smoother = settled(1e-6)
    joint, alone = episode.pilot.pose, smoother.pose
    assert np.hypot(*(joint - alone)[:2]) < 1e-3
    assert np.hypot(*(joint - episode.world.pose)[:2]) < 0.15  # one step of motion after the last tick


def test_the_pull_is_bounded() -> None:
    """However heavy the future, the estimate stays within the bound around what the past alone says."""
    episode, smoother = settled(1000.0)
    moved = fg.SE2.log(fg.SE2.between(smoother.pose, episode.pilot.pose))
    bound = np.array(episode.settings.controller.pull)
    assert (np.abs(moved) <= bound + 5e-4).all()
    assert (np.abs(moved) > 0.9 * bound).any()


def test_beams_keep_their_weights_during_a_solve(
    field: DistanceMap, past: Smoother, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights are chosen at the belief before the solve: a beam off the map counts nothing, however the poses move."""
    window = past.window
    registration = window.terms[1]
    assert isinstance(registration, Registration)

    def told(name: str) -> Array:
        """Of the beams of the present scan."""
        return np.asarray(registration.data(window.now(None))[f"lidar: {name}"])[-registration.beams :]

    right = told("which count").sum()
    moved = np.concatenate([window.history.states[:-1], window.history.states[-1:] + np.array([2.0, 0.0, 0.0])])
    monkeypatch.setattr(window.history, "states", moved)
    wrong = told("which count").sum()
    assert wrong < 0.8 * right
    information = told("information").ravel() * 0.01
    ends = lidar.in_world(window.history.states[-1:], told("end-points"))
    off = np.abs(field.distance(ends))
    assert information == pytest.approx(np.where(off < 0.3, (1.0 - (off / 0.3) ** 2) ** 2, 0.0), abs=1e-9)


def test_window_keeps_its_length_and_its_prior_is_of_the_past_alone(past: Smoother) -> None:
    window = past.window
    assert window.history.full and window.history.entered == window.length == WINDOW
    assert window.left.pending_prior is not None
    reference, information = window.left.pending_prior
    assert np.linalg.eigvalsh(information).min() > 0.0
    oldest = window.history.states[1]  # the prior is about the pose that is oldest after the next move
    lowest = fg.SE2.retract(reference[:3], reference[3:])
    assert np.hypot(*(lowest - oldest)[:2]) < 0.05


def test_covariance_counts_the_past_alone(past: Smoother) -> None:
    """Raising the control weight does not make the robot more certain of where it is."""
    window = past.window
    solution = window.solution
    assert solution is not None
    x = next(iter(solution.values))
    np.testing.assert_allclose(window.state_covariance, solution.covariance(x[-1]), rtol=1e-5)
    everything = solution.information(("initial", "arrival", "odometry", "lidar"), x)
    assert everything.shape == (3 * window.length + 3,) * 2
    np.testing.assert_allclose(window.state_covariance, np.linalg.inv(everything)[-3:, -3:], rtol=1e-5)


@pytest.mark.parametrize("solver", ["ipm", "sqp", "alm"])
@pytest.mark.product(2, of="drives and flights")
def test_joint_episode_reaches_its_goal(solver: str) -> None:
    settings = NavigationSettings(start=HERE, goals=(THERE,), coupling="joint", solver=solver, obstacles=1, seed=1)
    metrics = episode_metrics(run_navigation(settings))
    assert metrics["reached"]
    assert metrics["collisions"] == 0
    assert metrics["localisation_error_m"]["mean"] < 0.05
    assert metrics["max_bound_violation"] < 1e-3
