"""Every shipped residual's Jacobian against numerical differentiation, found by looking through the packages."""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np
import pytest

import unifg as fg
import unifg.models
from unifg.differentiation import jacobian
from unifg.models import lidar, obstacles, unicycle
from unifg.models.distance_map import DistanceMap
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
    return names - {f"{module}.residual" for module in ("lidar", "obstacles", "unicycle")}


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
