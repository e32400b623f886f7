"""Fixtures every test may use: the shared data beside the checkout, and reproducible randomness.

A test marked ``product(n)`` is a large table, of which n cases are drawn; another commit draws others. Tests marked
``product(n, of="name")`` are one table together; of ``product(0)`` none is drawn. Of the files in `HALVED`, long scenes
and large maps, half of what carries no mark is drawn. ``--all`` runs the whole, ``UNIFG_TEST_SEED`` repeats a draw.
"""

import gc
import os
import random
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from drawn import seed
from scripts import CHECKOUT

HALVED = """
    barriers best_guess certificate consistency control_cases control_decisions cops covariance elastic
    elimination_pose_graphs experiments horizon hostile_files imperfection joint large_maps lidar mujoco navigation
    own_planner plots quadrotor_estimator quadrotor_joint quadrotor_mpc quadrotor_obstacles quadrotor_scene
    quadrotor_world range_logs reproduce rkmk robust_drives safe_flight scalar_costs sensor_windows shared_work shipped
    solve submaps supervision tables uncertainty unforeseen unification_studies verdict
""".split()

# Syntax trees and compilers make many objects that live: looking through them again and again took a sixth of the time.
gc.set_threshold(100_000, 50, 50)

# Same examples on every machine and in every run: a red test stays red until the code changes.
settings.register_profile("unifg", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
# For hunting by hand: HYPOTHESIS_PROFILE=explore draws new examples each time, and more of them.
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "unifg"))


def _shared(folder: str, variable: str) -> Path:
    """Return a folder of the shared material, or skip the test that asked for it."""
    named = os.environ.get(variable)
    path = Path(named) if named else CHECKOUT.parent / "shared" / folder
    if not path.is_dir():
        if named:
            pytest.fail(f"${variable} names {named}, which is not a folder")
        pytest.skip(f"no folder ../shared/{folder} beside the checkout and ${variable} is not set")
    return path.resolve()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of maps, pose graphs and logs: `../shared/data`, or `$UNIFG_DATA`."""
    return _shared("data", "UNIFG_DATA")


@pytest.fixture(scope="session")
def shared_reference() -> Path:
    """Folder of independently computed reference answers: `../shared/reference`, or `$UNIFG_REFERENCE`."""
    return _shared("reference", "UNIFG_REFERENCE")


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a random generator that starts from the same seed in every test."""
    return np.random.default_rng(20260101)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare tests that look at other things the drawing of pictures, which takes a second each."""
    drawn = "matplotlib.backends.backend_agg.FigureCanvasAgg.print_png"
    monkeypatch.setattr(drawn, lambda canvas, path, **options: Path(path).write_text("png"))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--all``."""
    parser.addoption("--all", action="store_true", help="run every case of the tests marked as products")


def pytest_report_header(config: pytest.Config) -> str:
    """Say how to repeat the draw."""
    return "all cases" if config.getoption("--all") else f"products drawn with UNIFG_TEST_SEED={seed()}"


def pytest_collection_finish() -> None:
    """Leave what has been imported out of every later search for garbage."""
    gc.freeze()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the drawn cases of products, but for cases that are named on the command line."""
    if config.getoption("--all") or any("::" in argument for argument in config.args):
        return
    products = defaultdict[str, list[pytest.Item]](list)
    for item in items:
        if marker := item.get_closest_marker("product"):
            products[marker.kwargs.get("of", item.nodeid.partition("[")[0])].append(item)
        elif item.path.stem.removeprefix("test_") in HALVED:
            products[item.path.stem].append(item)
    dropped = set[pytest.Item]()
    for name, cases in products.items():
        marker = cases[0].get_closest_marker("product")
        count = marker.args[0] if marker else (len(cases) + 1) // 2
        kept = random.Random(f"{seed()} {name}").sample(cases, min(len(cases), count))
        dropped |= {*cases} - {*kept}
    config.hook.pytest_deselected(items=list(dropped))
    items[:] = [item for item in items if item not in dropped]
