"""Solvers of casadi with their functions in machine code give the same answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import compiled_peers

ca = pytest.importorskip("casadi", reason="compiled peers are casadi's, which comes with the extra 'bench'")


@pytest.mark.skipif(compiled_peers.COMPILER is None, reason="no C compiler")
def test_machine_code_gives_the_same_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_peers, "LIBRARIES", tmp_path)
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    program = {"x": x, "p": p, "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2, "g": x[0] ** 2 + x[1] ** 2 - p}
    options: dict[str, Any] = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    plain = ca.nlpsol("solver", "ipopt", program, options)
    fast = compiled_peers.compiled(plain, "ipopt", options)
    call = {"x0": [0.1, 0.2], "p": 0.5, "lbg": -np.inf, "ubg": 0.0}
    first, second = plain(**call), fast(**call)
    np.testing.assert_allclose(np.array(second["x"]), np.array(first["x"]), atol=1e-9)
    np.testing.assert_allclose(np.array(second["lam_g"]), np.array(first["lam_g"]), rtol=1e-6)
    assert fast.stats()["iter_count"] == plain.stats()["iter_count"]

    (library,) = tmp_path.iterdir()
    made = library.stat().st_mtime_ns
    compiled_peers.compiled(plain, "ipopt", options)
    assert library.stat().st_mtime_ns == made  # kept by its content
