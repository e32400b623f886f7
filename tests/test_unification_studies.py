"""What the studies of unification count, and that each still measures."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import covariance_plans


def row(way: str, seed: int, found: list[tuple[float, float] | None]) -> dict[str, object]:
    """A row of the campaign with (time, collisions) of each setting."""
    numbers = {"clearance": 0.1, "miss": 0.1, "sigma": 0.1}
    return {
        "way": way, "seed": seed, "drives": 10, "seconds": 0.1,
        "found": [None if f is None else {"time": f[0], "collisions": f[1], **numbers} for f in found],
    }  # fmt: skip


def test_settings_are_compared_at_equal_risk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(covariance_plans, "WAYS", {"margin": (0.1, 0.5), "in the graph": (1.0, 3.0)})
    rows = [
        row("margin", 0, [(10.0, 0.2), (12.0, 0.01)]), row("margin", 1, [(10.0, 0.04), None]),
        row("in the graph", 0, [(10.5, 0.01), (11.5, 0.0)]), row("in the graph", 1, [(10.2, 0.03), (11.0, 0.0)]),
        row("in the graph", 2, [None, None]),
    ]  # fmt: skip
    found = covariance_plans.Campaign(rows, 10)
    assert found.seeds == [0, 1]
    assert found.collisions("margin", 0) == pytest.approx(0.12)
    settings = [found.setting("in the graph", target) for target in (0.05, 0.001)]
    assert found.setting("margin", 0.05) == 1 and settings == [0, 1]
    assert found.setting("margin", 0.001) is None
    np.testing.assert_array_equal(found.best("margin", 0.02), [12.0, np.nan])
    np.testing.assert_array_equal(found.best("in the graph", 0.02), [10.5, 11.0])
    text = covariance_plans.render(found, 10)
    assert "| margin 0.5 m | 1 / 2 |" in text and "| 2% | in the graph | 2 / 2 | -1.5 (-1.5 .. -1.5), n=1 |" in text
