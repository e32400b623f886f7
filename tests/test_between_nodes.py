"""Clearance between the nodes of a plan: its bound, its value and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from test_barriers import CENTRE, EXACT, RADIUS, RNG, spheres
from unifg.models import between_nodes


def test_nodes_that_keep_the_margin_are_never_inside_in_between() -> None:
    """Random steps, accelerations up to the limit, dense samples; and the margin is no more than it has to be."""
    rng = np.random.default_rng(3)
    least = np.inf
    s = np.linspace(0.0, 1.0, 401)[:, None]
    for _ in range(3000):
        rho, a, dt = (float(rng.uniform(*span)) for span in [(0.0, 1.0), (0.0, 8.0), (0.02, 0.4)])
        way = rng.normal(size=3) * rng.uniform(0.0, 1.5)
        margin = float(between_nodes.sag(np.linalg.norm(way), rho, a, dt))
        turn = rng.normal(size=3)
        turn -= (turn @ way) / (float(way @ way) + 1e-12) * way
        out = turn / np.linalg.norm(turn)
        reach = rho + margin
        height = np.sqrt(max(reach**2 - float(way @ way) / 4.0, 0.0))  # both ends on the ball that nodes keep out of
        aside = -out if rng.random() < 0.7 else rng.normal(size=3)
        aside /= float(np.linalg.norm(aside))
        path = out * height + (s - 0.5) * way + 0.5 * a * dt**2 * s * (1.0 - s) * aside
        ends = np.linalg.norm(path[[0, -1]], axis=1)
        assert (ends >= reach - 1e-9).all()
        least = min(least, (np.linalg.norm(path, axis=1) - rho).min())
    assert -1e-9 < least < 1e-3


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((0.15, 0.75), 0.15**2 / 8 / 0.75),  # 3 m/s at 50 ms past 0.75 m
        ((0.0, 0.75, 4.0, 0.1), 4.0 * 0.01 / 8),
        ((0.3, 0.0), 0.15),
    ],
)
def test_the_size_of_the_sag(arguments: tuple[float, ...], expected: float) -> None:
    assert float(between_nodes.sag(*arguments)) == pytest.approx(expected, rel=0.01)


def test_passing_is_the_least_of_dense_samples() -> None:
    p, q = RNG.normal(size=(40, 3)), RNG.normal(size=(40, 3))
    after = CENTRE + RNG.normal(size=(2, 3))
    s = np.linspace(0.0, 1.0, 4001)
    found = between_nodes.passing(p, q, CENTRE, after, RADIUS)
    for k in range(40):
        ways = p[k] + s[:, None] * (q[k] - p[k])
        centres = CENTRE + s[:, None, None] * (after - CENTRE)
        sampled = (np.linalg.norm(ways[:, None] - centres, axis=2) - RADIUS).min(axis=0)
        np.testing.assert_allclose(found[k], sampled, atol=1e-3)
        assert (found[k] <= sampled + 1e-12).all()
    rests = between_nodes.passing(p, p, CENTRE, CENTRE, RADIUS)
    np.testing.assert_allclose(rests, spheres(p), atol=1e-14)
    flat = between_nodes.passing(p, q, CENTRE[:, :2], CENTRE[:, :2], RADIUS)
    np.testing.assert_allclose(flat, between_nodes.passing(p[:, :2], q[:, :2], CENTRE[:, :2], CENTRE[:, :2], RADIUS))


def test_passing_has_exact_derivatives_in_a_graph() -> None:
    graph, p = graph_with(fg.Rn(3), 9, "p")
    graph.minimize(fg.prior, p, np.zeros(3))
    graph.constrain(between_nodes.passing, p[:-1], p[1:], CENTRE, CENTRE + 0.2, RADIUS, lower=-10.0, name="passing")
    found = graph.check({p: RNG.normal(size=(9, 3))})
    assert found and found.routes["passing"] == EXACT
