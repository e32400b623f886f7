"""Scenes in other viewers: what Rerun's file holds, and what a browser would be sent by viser, against the scene."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unifg.errors import ViewError
from unifg.view import Scene


def small() -> Scene:
    """Three frames of a body that turns, with a way that grows, a plan that changes and a number."""
    scene = Scene("small", dt=0.5)
    scene.discs("pillars", [[1.0, 2.0, 0.3]], height=1.0, colour="fixed", opacity=0.5)
    scene.body("robot", "disc", size=0.2)
    scene.plot("speed", unit="m/s")
    for k in range(3):
        frame = scene.frame()
        frame.place("robot", [0.5 * k, 0.0, 0.25 * np.pi * k])
        frame.trail("driven", [0.5 * k, 0.0])
        if k < 2:
            frame.way("plan", np.array([[0.5 * k, 0.0], [2.0, 1.0]]))
        frame.value("speed", 1.0 + k)
    return scene


def test_rerun_holds_the_scene(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: 170 MB, and not in the test extra")
    chunks = pytest.importorskip("rerun.chunk")
    small().rerun(tmp_path / "small.rrd").disconnect()
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in chunks.RrdReader(tmp_path / "small.rrd").stream():
        rows.setdefault(str(chunk.entity_path), []).extend(chunk.to_record_batch().to_pylist())
    assert {"/pillars", "/robot", "/plan", "/plots/speed"} <= rows.keys(), sorted(rows)

    def told(path: str, word: str) -> list[Any]:
        return [value for row in rows[path] for name, value in row.items() if word in name and value is not None]

    assert [value[0] for value in told("/plots/speed", "Scalars:scalars")] == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(np.array(told("/robot", "translation"))[:, 0, 0], [0.0, 0.5, 1.0])
    turns = np.array(told("/robot", "quaternion"))[:, 0]
    np.testing.assert_allclose(2.0 * np.arctan2(turns[:, 2], turns[:, 3]), 0.25 * np.pi * np.arange(3), atol=1e-6)
    assert len(told("/plan", "vertex_positions")) == 2 and told("/plan", "is_recursive") == [[True]]
    assert sorted(path for path in rows if path.startswith("/driven/")) == ["/driven/1", "/driven/2"]
    corners = np.array(told("/pillars", "vertex_positions")[0])
    assert np.hypot(corners[:, 0] - 1.0, corners[:, 1] - 2.0).max() == pytest.approx(0.3, rel=1e-5)


def test_viser_shows_the_frame_of_the_slider() -> None:
    pytest.importorskip("viser")
    server = small().viser(port=8190)
    try:
        handles = server.scene._handle_from_node_name
        assert {"/pillars", "/robot/body", "/plan"} <= handles.keys()
        assert np.ptp(handles["/robot/body"].vertices, axis=0)[0] == pytest.approx(0.4, rel=1e-2)
        assert handles["/pillars"].opacity == 0.5
        (slider,) = server.gui._gui_input_handle_from_uuid.values()
        slider.value = 2
        assert handles["/robot/body"].vertices[:, 0].mean() == pytest.approx(1.0, abs=1e-2)
        assert "/plan" not in handles and "/driven" in handles and "/pillars" in handles
    finally:
        server.stop()


@pytest.mark.parametrize("name", ["rerun", "viser"])
def test_without_it_it_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ViewError, match=rf"pip install 'unifg\[{name}\]'"):
        getattr(small(), name)()
