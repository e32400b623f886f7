"""Every shipped residual's Jacobian against numerical differentiation, found by looking through the packages."""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np
import pytest

import unifg as fg
import unifg.models
from unifg.differentiation import jacobian
from unifg.models import lidar, obstacles, rkmk, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.potential import potential
from unifg.models.smooth_field import SmoothField
from unifg.residuals import Residual
from unifg.typing import Array

RNG = np.random.default_rng(7)
COUNT = 9


def poses(count: int = COUNT) -> Array:
    """Poses all over the plane, headings up to the cut at pi."""
    x = fg.SE2.random(RNG, (count,))
    x[0, 2] = -np.pi
    return x


def vectors(size: int) -> Array:
    return RNG.normal(size=(COUNT, size))


# name -> (residual, variable arguments, their manifolds, constants)
CASES: dict[str, tuple[Residual, list[Array], list[fg.Manifold], list[object]]] = {
    "unicycle.dynamics": (
        unicycle.dynamics, [poses(), vectors(2), poses()], [fg.SE2, fg.Rn(2), fg.SE2], [0.13],
    ),
    "unicycle.tracking": (unicycle.tracking, [poses()], [fg.SE2], [poses()]),
    "unicycle.rate": (unicycle.rate, [vectors(2), vectors(2)], [fg.Rn(2), fg.Rn(2)], []),
    "obstacles.disc_clearance": (
        obstacles.disc_clearance, [poses()], [fg.SE2], [RNG.normal(size=(4, 2)), np.full(4, 0.3)],
    ),
}  # fmt: skip
GRID = DistanceMap(np.add.outer(np.sin(np.arange(30.0)), np.cos(0.7 * np.arange(40.0))), 0.25, (-5.0, -4.0, 0.3))
INSIDE = np.concatenate([RNG.uniform(-1.5, 1.5, (COUNT, 2)), poses()[:, 2:]], axis=1)
WALLS = obstacles.wall_distance(SmoothField(GRID))
CASES["lidar.endpoint"] = (lidar.endpoint(GRID), [INSIDE], [fg.SE2], [RNG.uniform(-1.0, 1.0, (COUNT, 2))])
CASES["obstacles.wall_distance"] = (WALLS, [INSIDE], [fg.SE2], [])
CASES["obstacles.shortfall"] = (obstacles.shortfall(WALLS, 0.3), [INSIDE], [fg.SE2], [])
for group in (fg.Rn(3), fg.SO2, fg.SE2, fg.Product(pose=fg.SE2, v=fg.Rn(2))):
    x, y, z = (group.random(RNG, (COUNT,)) for _ in range(3))
    CASES[f"prior on {group.name}"] = (fg.prior.on(group), [x], [group], [y])
    CASES[f"between on {group.name}"] = (fg.between.on(group), [x, y], [group, group], [z])
    CASES[f"difference on {group.name}"] = (fg.difference.on(group), [x, y], [group, group], [])


def current(x: Array, u: Array) -> Array:
    """A field on SE(2) that depends on the pose."""
    return np.stack([u[:, 0] * (1.2 + np.sin(x[:, 1])), 0.4 * np.cos(x[:, 2]), u[:, 1] + 0.2 * x[:, 0]], axis=1)


def accelerated(x: Array, u: Array) -> Array:
    """A field on a pose with its velocities (v, omega), driven by their rates."""
    return np.concatenate([rkmk.unicycle_field(x, x[:, 3:]), u - 0.3 * x[:, 3:] ** 2], axis=1)


NEARBY = fg.SE2.retract(poses(), RNG.normal(size=(COUNT, 3)))
STEP = [poses(), vectors(2), NEARBY]
MOVING = fg.Product(pose=fg.SE2, v=fg.Rn(2))
MOTION = [MOVING.random(RNG, (COUNT,)), vectors(2), MOVING.random(RNG, (COUNT,))]
CASES["rkmk.trapezoid"] = (rkmk.trapezoid(fg.SE2, current), STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3])
CASES["rkmk.trapezoid, simplified"] = (
    rkmk.trapezoid(fg.SE2, current, "simplified"), STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3],
)  # fmt: skip
CASES["rkmk.trapezoid, given derivative"] = (
    rkmk.trapezoid(fg.SE2, rkmk.unicycle_field, jacobian=rkmk.unicycle_field_jacobian),
    STEP, [fg.SE2, fg.Rn(2), fg.SE2], [0.3],
)  # fmt: skip
CASES["rkmk.trapezoid, pose and velocity"] = (
    rkmk.trapezoid(MOVING, accelerated), MOTION, [MOVING, fg.Rn(2), MOVING], [0.3],
)  # fmt: skip
DISCS: list[object] = [RNG.normal(size=(4, 2)), np.full(4, 0.3)]
CASES["potential.potential"] = (potential(obstacles.disc_clearance), [poses()], [fg.SE2], DISCS)
CASES["potential.potential, walls"] = (potential(WALLS), [INSIDE], [fg.SE2], [])
CASES["potential.potential, vortex"] = (potential(obstacles.disc_clearance, vortex=0.7), [poses()], [fg.SE2], DISCS)

# Their search Jacobians are the derivative of nothing; everything else about them is tested like the rest.
EXEMPT_SEARCH = {"potential.potential, vortex"}


def shipped() -> set[str]:
    """Every module-level residual of unifg.models that attaches a Jacobian."""
    names = set()
    for module in pkgutil.iter_modules(unifg.models.__path__):
        loaded = importlib.import_module(f"unifg.models.{module.name}")
        for name, value in vars(loaded).items():
            if isinstance(value, Residual) and value.jacobian is not None and not name.startswith("_"):
                names.add(f"{module.name}.{name}")
            if callable(value) and getattr(value, "__annotations__", {}).get("return") == "Residual":
                names.add(f"{module.name}.{name}")  # a function that makes residuals
    return names - {f"{module}.residual" for module in ("lidar", "obstacles", "potential", "rkmk", "unicycle")}


def test_every_shipped_residual_has_a_case() -> None:
    assert shipped() <= set(CASES), shipped() - set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_jacobian(name: str) -> None:
    case, points, manifolds, constants = CASES[name]
    assert case.jacobian is not None
    blocks = case.jacobian(*points, *constants)
    numerical = jacobian(lambda *p: case.function(*p, *constants), points, manifolds)
    for block, reference in zip(blocks, numerical, strict=True):
        np.testing.assert_allclose(block, reference, atol=2e-8, rtol=1e-7)


def test_only_named_search_jacobians_are_exempt() -> None:
    assert {name for name, (case, *_) in CASES.items() if case.search is not None} == EXEMPT_SEARCH
    for name in EXEMPT_SEARCH:
        case, points, manifolds, constants = CASES[name]
        assert case.search is not None
        blocks = case.search(*points, *constants)
        numerical = jacobian(lambda *p, c=case, k=constants: c.function(*p, *k), points, manifolds)
        assert max(np.abs(b - n).max() for b, n in zip(blocks, numerical, strict=True)) > 1e-2, f"{name}: not needed"
