"""Fixtures every test may use: the shared data beside the checkout, and reproducible randomness."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

CHECKOUT = Path(__file__).resolve().parent.parent

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
