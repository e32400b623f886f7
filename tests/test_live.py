"""A scene that is served while it is made: what a browser is told, and that nobody waits for it."""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from scenes import without_viewer
from unifg.errors import ViewError
from unifg.solvers import GaussNewton
from unifg.view import Live, Scene

pytest.importorskip("meshcat")
tornado = pytest.importorskip("tornado.websocket")
umsgpack = pytest.importorskip("umsgpack")

Message = dict[str, Any]


def browser(live: Live, then: Callable[[Callable[[], Awaitable[Message]]], Awaitable[Any]], **headers: str) -> Any:
    """Result of listening to the server as a browser does."""

    async def listen() -> Any:
        from tornado.httpclient import HTTPRequest

        request = HTTPRequest(live.url.replace("http", "ws") + "wire", headers=headers)
        wire = await tornado.websocket_connect(request)

        async def hear() -> Message:
            text = await asyncio.wait_for(wire.read_message(), 10.0)
            assert text is not None, "the server has hung up"
            heard: Message = json.loads(text)
            return heard

        try:
            return await then(hear)
        finally:
            wire.close()
            while await asyncio.wait_for(wire.read_message(), 10.0) is not None:
                continue  # until it is closed

    return asyncio.run(listen())


def commands(message: Message) -> list[tuple[str, str]]:
    """Commands to the viewer in a message: kind and path below /meshcat/."""
    plain = [umsgpack.unpackb(base64.b64decode(text)) for text in message["commands"]]
    return [(c["type"], c["path"].removeprefix("/meshcat/")) for c in plain if c["path"].startswith("/meshcat/")]


def moving(**options: Any) -> Scene:
    scene = Scene("live", dt=0.1, **options)
    scene.discs("pillar", [[1.0, 1.0, 0.2]], height=1.0)
    scene.body("robot", "disc", size=0.2)
    return scene


def step(scene: Scene, k: int) -> None:
    with scene.frame() as frame:
        frame.place("robot", [0.1 * k, 0.0, 0.0])
        frame.way("plan", [[0.1 * k, 0.0], [0.1 * k + 1.0, 0.5]])
        frame.trail("driven", [0.1 * k, 0.0])
        frame.readout("tick", str(k), alarm=k == 3)
        frame.value("error", float(k))


def test_a_browser_is_told_what_is_there_and_then_what_changes() -> None:
    scene = moving()
    with scene.live() as live:
        step(scene, 0)

        async def watch(hear: Callable[[], Awaitable[Message]]) -> list[Message]:
            first = await hear()
            step(scene, 1)
            return [first, await hear()]

        first, second = browser(live, watch)
    sent = commands(first)
    assert ("set_object", "pillar") in sent and ("set_object", "plan/now") in sent
    assert ("set_transform", "robot") in sent and any(path.startswith("robot/parts") for _, path in sent)
    again = commands(second)
    assert ("set_object", "plan/now") in again and ("set_object", "driven/way") in again
    assert not any(path == "pillar" or path.startswith("robot/parts") for _, path in again)  # it has them
    assert second["page"]["now"] == [["tick", "1", False]] and second["page"]["clock"] == "0.10 s"
    assert second["page"]["plots"][0]["now"] == 1.0
    assert [key["text"] for key in second["page"]["legend"]] == ["pillar", "robot", "plan", "driven"]


def test_what_is_no_more_is_taken_away() -> None:
    scene = moving()
    with scene.live() as live:
        step(scene, 0)

        async def watch(hear: Callable[[], Awaitable[Message]]) -> Message:
            await hear()
            with scene.frame() as frame:
                frame.points("hit", [[0.0, 0.0]])
            return await hear()

        sent = commands(browser(live, watch))
    assert ("delete", "plan/now") in sent and ("delete", "robot/parts") in sent and ("set_object", "hit/now") in sent


def test_whoever_is_slow_misses_frames_and_ends_with_the_last() -> None:
    scene = moving(keep=2)
    with scene.live() as live:
        step(scene, 0)

        async def watch(hear: Callable[[], Awaitable[Message]]) -> list[str]:
            await hear()
            for k in range(1, 400):
                step(scene, k)
            seen: list[str] = []
            while not seen or seen[-1] != "399":
                seen.append((await hear())["page"]["now"][0][1])
            return seen

        seen = browser(live, watch)
    assert len(seen) < 20


def test_the_loop_neither_waits_nor_works_where_nobody_watches() -> None:
    scene = moving(keep=1)
    with scene.live() as live:
        began = time.process_time()
        for k in range(1000):
            step(scene, k)
        assert time.process_time() - began < 2.0
        assert live.watching == 0


def test_browsers_come_and_go() -> None:
    scene = moving()
    with scene.live() as live:
        step(scene, 0)

        async def once(hear: Callable[[], Awaitable[Message]]) -> Message:
            return await hear()

        one, other = browser(live, once), browser(live, once)
        assert commands(one) == commands(other)
        end = time.monotonic() + 10.0
        while live.watching and time.monotonic() < end:
            time.sleep(0.01)
        assert live.watching == 0


def test_the_page_is_served_to_this_machine_only() -> None:
    with moving().live() as live:
        assert live.url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(live.url, timeout=10.0) as answer:
            page = answer.read().decode()
        assert "listen();" in page and "connect-src 'self' ws:" in page and "@@" not in without_viewer(page)
        stranger = urllib.request.Request(live.url, headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(stranger, timeout=10.0)
        assert refused.value.code == 404
        refused.value.close()

        async def never(hear: Callable[[], Awaitable[Message]]) -> None:
            raise AssertionError("a page of another host may listen")

        with pytest.raises(Exception, match="403"):
            browser(live, never, Origin="http://example.org")


def test_a_taken_port_gives_another() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with Scene().live(port) as one, Scene().live(port) as other:
            assert len({port, *(int(live.url.rsplit(":", 1)[1].strip("/")) for live in (one, other))}) == 3


def test_closing_ends_everything() -> None:
    scene = moving()
    live = scene.live()
    port = int(live.url.rsplit(":", 1)[1].strip("/"))
    live.close()
    live.close()
    assert "unifg live view" not in [thread.name for thread in threading.enumerate()]
    step(scene, 0)  # nobody is told, and nothing breaks
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", port))


def test_an_impossible_port_is_refused() -> None:
    with pytest.raises(ViewError, match="cannot be served"), pytest.MonkeyPatch.context() as patched:
        patched.setattr(socket.socket, "bind", _none_free)
        Scene().live()


def _none_free(*args: object) -> None:
    raise OSError("they are all taken")


def test_a_solution_is_added_to_what_is_watched() -> None:
    graph, x = graph_with(fg.SE2, 3)
    graph.minimize(fg.prior, x, np.zeros(3), sigma=1.0)
    solution = GaussNewton().solve(graph, {x: np.ones((3, 3))})
    scene = Scene.of(solution, x, dt=0.1)
    with scene.live() as live:

        async def watch(hear: Callable[[], Awaitable[Message]]) -> list[Message]:
            first = await hear()
            scene.add(solution)
            return [first, await hear()]

        first, second = browser(live, watch)
    assert ("set_object", "x: poses/now") in commands(first)
    assert not any(kind == "set_object" for kind, _ in commands(second))  # it looks the same
    assert len(scene.shots) == 2


def test_a_failed_frame_is_not_shown() -> None:
    scene = moving()
    with scene.live() as live:
        step(scene, 0)
        with pytest.raises(ViewError), scene.frame() as frame:
            frame.points("bad", [[np.nan, 0.0]])

        async def watch(hear: Callable[[], Awaitable[Message]]) -> Message:
            return await hear()

        assert browser(live, watch)["page"]["now"] == [["tick", "0", False]]
    assert len(scene.shots) == 1


def test_an_origin_far_away_is_where_the_picture_is() -> None:
    scene = Scene("far", dt=0.1)
    scene.body("car", "car", size=2.0)
    with scene.live() as live:
        with scene.frame() as frame:
            frame.place("car", [5e5, 5.4e6, 0.0])

        async def watch(hear: Callable[[], Awaitable[Message]]) -> Message:
            return await hear()

        message = browser(live, watch)
    assert np.abs(np.array(message["page"]["corners"])).max() < 10.0
    plain = [umsgpack.unpackb(base64.b64decode(text)) for text in message["commands"]]
    (matrix,) = [c["matrix"] for c in plain if c["type"] == "set_transform" and c["path"] == "/meshcat/car"]
    assert np.abs(matrix).max() < 10.0


def test_a_run_is_watched_tick_by_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every tick that is recorded is a frame; the log in the making answers as the log does."""
    from episodes import episode
    from unifg.scenarios.commands.watching import watching_ticks
    from unifg.scenarios.logs.columns import Recorder, columns, watched
    from unifg.scenarios.logs.drive_log import EpisodeLog
    from unifg.scenarios.scenes.drive_scene import drive_frame, drive_stage

    done = episode(ticks=6, obstacles=4)
    names = columns(EpisodeLog)
    known = {name: value for name, value in vars(done).items() if name not in names}
    told: list[str] = []
    scenes: list[Scene] = []

    def begin(log: Any) -> Scene:
        scenes.append(drive_stage(log))
        return scenes[-1]

    with watching_ticks(told.append, begin, drive_frame):
        recorder = Recorder(EpisodeLog, **{k: v for k, v in known.items() if k not in ("collisions", "reached")})
        with watched(None):  # a rehearsal
            Recorder(EpisodeLog, **known).add(**{name: getattr(done, name)[0] for name in names})
        for tick in range(done.ticks):
            recorder.add(**{name: getattr(done, name)[tick] for name in names})
    assert len(told) == 1 and told[0].startswith("http://127.0.0.1:")
    (scene,) = scenes
    assert [shot.number for shot in scene.shots] == list(range(6))
    np.testing.assert_allclose(scene.shots[-1].placed["robot"].position[:2], done.true_pose[-1, :2])
    assert {"obstacle 0", "obstacle 3"} <= scene.shots[0].placed.keys()
    assert "unifg live view" not in [thread.name for thread in threading.enumerate()]
    with watching_ticks(None, begin, lambda *given: None):
        Recorder(EpisodeLog, **known).add(**{name: getattr(done, name)[0] for name in names})
    assert len(scenes) == 1  # nobody wants to see it


@pytest.mark.usefixtures("undrawn")
def test_the_command_says_where_a_run_can_be_watched(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from unifg.scenarios import command

    assert command.main(["run", "manoeuvres", "--case", "obstacle", "--live", "--out", str(tmp_path)]) == 0
    assert "live: http://127.0.0.1:" in capsys.readouterr().err
