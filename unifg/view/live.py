"""A scene in a browser while it is made: a server on this machine that shows the latest frame.

The loop that makes frames only hands them over: meshes are built and sent by a thread of the server, and only while a
browser is there. Whoever is slow misses frames, but never holds the loop back, and is not told what it knows.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import threading
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.lie import SE3
from unifg.typing import Array
from unifg.view.content import Body, Content, Placement, Shot
from unifg.view.recorder import load_meshcat
from unifg.view.recording import Ground, ground_of, lay_ground, number_of, page_of, set_body
from unifg.view.stage import Stage, page_text
from unifg.view.things import Thing, draw_way

__all__ = ["Live"]

logger = logging.getLogger("unifg")
_PORTS = 20  # tried one after the other, then any
_PAUSE = 0.04  # seconds between two frames for one browser
_TRAIL = 2000  # places of a way that grows; beyond, every second is forgotten
_SHARE = 20  # of what a file may hold of a thing, one frame that is sent
_LONGEST = 10.0  # seconds to wait for the server to begin or to end
_CONNECT = "; connect-src 'self' ws:"


@dataclass
class Known:
    """Objects that a browser has been sent.

    Attributes:
        drawn: what it has, by path.
        placed: where its bodies are.
        trails: how many places each way had.
        lit: whether lights and background are set.
        grid: corners of the ground when its lines were drawn.
    """

    drawn: dict[str, Thing | Body] = field(default_factory=dict)
    placed: dict[str, Placement] = field(default_factory=dict)
    trails: dict[str, int] = field(default_factory=dict)
    lit: bool = False
    grid: tuple[list[float], list[float]] | None = None


class Live:
    """A scene that is served; made by :meth:`unifg.view.Scene.live`.

    Attributes:
        url: to open in a browser on this machine.
        watching: how many browsers are there.
    """

    def __init__(self, content: Content, port: int) -> None:
        """Begin to serve.

        Raises:
            ViewError: meshcat is not installed, or no port is free.
        """
        load_meshcat()
        self.url, self.watching = "", 0
        self._content = content
        self._latest = content.shots[-1] if content.shots else Shot(0)
        self._ground: Ground | None = None
        self._trails: dict[str, list[Array]] = {}
        self._passed: dict[str, int] = {}
        for shot in content.shots:
            self._remember(shot)
        self._lock, self._begun = threading.Lock(), threading.Event()
        self._error: BaseException | None = None
        self._stop: asyncio.Event | None = None
        self._news: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, args=(port,), name="unifg live view", daemon=True)
        self._thread.start()
        self._begun.wait(_LONGEST)
        if self._error is not None or not self.url:
            raise ViewError(f"the live view cannot be served: {self._error or 'the server did not begin'}")
        content.watchers.append(self.show)
        logger.info("live view at %s", self.url)

    def show(self, shot: Shot) -> None:
        """Show a frame, and return at once; called at the end of each frame of the scene."""
        with self._lock:
            self._latest = shot
            self._remember(shot)
        self._tell()

    def close(self) -> None:
        """End the server and free its port; browsers keep the last picture. Again does nothing."""
        if self.show in self._content.watchers:
            self._content.watchers.remove(self.show)
        if self._loop is not None and self._stop is not None:
            with contextlib.suppress(RuntimeError):  # it has ended already
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(_LONGEST)

    def __enter__(self) -> Live:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()

    def __repr__(self) -> str:
        """Address of the page."""
        return f"<Live at {self.url}, {self.watching} watching>"

    def _remember(self, shot: Shot) -> None:
        for name, place in shot.trails.items():
            places = self._trails.setdefault(name, [])
            places.append(place)
            self._passed[name] = self._passed.get(name, 0) + 1
            if len(places) > _TRAIL:
                del places[1:-1:2]

    def _tell(self) -> None:
        """Wake whoever sends."""

        def ring() -> None:
            for news in self._news:
                news.set()

        if self._loop is not None and self._news:
            with contextlib.suppress(RuntimeError):  # it has just ended
                self._loop.call_soon_threadsafe(ring)

    # ------------------------------------------------------------------- the server's thread

    def _run(self, port: int) -> None:
        try:
            asyncio.run(self._serve(port))
        except BaseException as error:  # told to whoever waits for the beginning
            self._error = error
        finally:
            self._begun.set()

    async def _serve(self, port: int) -> None:
        from tornado.httpserver import HTTPServer
        from tornado.web import Application, RequestHandler
        from tornado.websocket import WebSocketClosedError, WebSocketHandler

        live, script = self, resources.files("unifg.view").joinpath("live.js").read_text(encoding="utf-8")

        class Front(RequestHandler):
            """The page."""

            def get(self) -> None:
                """Send it."""
                self.set_header("Cache-Control", "no-store")
                tag = f'<script>\n"use strict";\n{script}</script>\n'
                self.write(page_text(live._first(), [], connect=_CONNECT, live=tag))

        class Wire(WebSocketHandler):
            """Connection to a browser; tornado refuses those that come from pages of other hosts."""

            ended = False

            def open(self, *args: str, **named: str) -> None:
                """Begin to send; a browser that leaves is heard of only after this has returned."""
                self.news = asyncio.Event()
                self.task = asyncio.create_task(self.send_news())

            async def send_news(self) -> None:
                """Send what is new, as long as the browser is there."""
                news, known = self.news, Known()
                live._news.add(news)
                live.watching += 1
                news.set()
                try:
                    while True:
                        await news.wait()
                        news.clear()
                        if self.ended:
                            break
                        message = live._message(known)
                        if message is not None:
                            await self.write_message(message)
                        await asyncio.sleep(_PAUSE)
                except WebSocketClosedError:
                    pass
                except Exception:
                    logger.exception("the live view cannot show this frame")
                    self.close()
                finally:
                    live._news.discard(news)
                    live.watching -= 1

            def on_close(self) -> None:
                """Stop sending."""
                self.ended = True
                self.news.set()

            def on_message(self, message: str | bytes) -> None:
                """Nothing is asked of us."""

        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        listening = _socket(port)
        application = Application(log_function=lambda handler: None)
        # Only by a name of this machine: a page elsewhere whose name is made to lead here gets nothing.
        application.add_handlers(r"^(127\.0\.0\.1|localhost)$", [(r"/", Front), (r"/wire", Wire)])
        server = HTTPServer(application)
        server.add_socket(listening)
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        self._begun.set()
        try:
            await self._stop.wait()
        finally:
            server.stop()
            await server.close_all_connections()

    def _first(self) -> dict[str, Any]:
        """First message of the page, before anything is drawn."""
        empty = Content(self._content.title, None, "live")
        ground = Ground(np.array([-1.0, -1.0, 0.0]), np.ones(3), np.zeros(3), 2.0, True)
        return page_of(empty, ground, []) | {
            "live": True, "readouts": [], "speeds": [], "counts": "live", "numbers": [0], "ticks": [0],
            "dt": 1.0, "duration": 0.0, "step": 1.0, "play": False,
        }  # fmt: skip

    def _message(self, known: Known) -> str | None:
        """Objects that a browser lacks; None while there is nothing to show."""
        content = self._content
        with self._lock:
            shot = self._latest
            trails = {name: (self._passed[name], np.array(places)) for name, places in self._trails.items()}
        try:
            ground = self._grown(ground_of(content, [shot]))
        except ViewError:
            return None
        stage = Stage(1, 1.0, origin=ground.origin, stroke=ground.stroke)
        if known.lit:
            stage.recorder.commands.clear()
        known.lit = True
        corners = (ground.low.tolist(), ground.high.tolist())
        if known.grid != corners:
            known.grid = corners
            lay_ground(stage, content, ground)
        self._draw(stage, shot, known)
        for name, placed in shot.placed.items():
            if known.placed.get(name) is not placed:
                stage.place(content.layers[name].path, _matrix(placed, ground.origin))
                known.placed[name] = placed
        for name, (passed, points) in trails.items():
            if passed > 1 and known.trails.get(name) != passed:
                known.trails[name] = passed
                layer = content.layers[name]
                path, flat = f"{layer.path}/way", content.flat_trails[name]
                draw_way(stage, path, 400, layer, points=points, flat=flat, width=layer.width)
        commands = stage.recorder.packed_base64()
        return json.dumps({"page": self._words(shot, ground), "commands": commands}, allow_nan=False)

    def _grown(self, ground: Ground) -> Ground:
        """The ground of all that has been seen: a view of everything that follows each frame would tremble."""
        before = self._ground
        if before is not None:  # some room beyond, so that it need not grow again at once
            reach = np.maximum(before.high, ground.high) - np.minimum(before.low, ground.low)
            size = max(float(reach.max()), before.size)
            margin = 0.1 * size * np.array([1.0, 1.0, 0.0])
            low = np.where(ground.low < before.low, ground.low - margin, before.low)
            high = np.where(ground.high > before.high, ground.high + margin, before.high)
            ground = Ground(low, high, before.origin, size, before.flat and ground.flat)
        self._ground = ground
        return ground

    def _draw(self, stage: Stage, shot: Shot, known: Known) -> None:
        """Send what is new, and take away what is no more."""
        content = self._content
        wanted: dict[str, tuple[str, Thing | Body]] = {}
        for name, thing in dict(content.things).items():
            wanted[content.layers[name].path] = name, thing
        for name, thing in shot.things.items():
            wanted[f"{content.layers[name].path}/now"] = name, thing
        for name in shot.placed:
            wanted[f"{content.layers[name].path}/parts"] = name, content.bodies[name]
        for path in known.drawn.keys() - wanted.keys():
            stage.delete(path)
            del known.drawn[path]
        for path, (name, now) in wanted.items():
            before = known.drawn.get(path)
            if before is now:
                continue
            if isinstance(now, Body):
                set_body(stage, content.layers[name], now)
            elif not (isinstance(before, Thing) and now.same(before)):
                if before is not None:
                    stage.delete(path)
                now.put(stage, path, max(2, now.budget // _SHARE), content.layers[name])
            known.drawn[path] = now

    def _words(self, shot: Shot, ground: Ground) -> dict[str, Any]:
        """Text of the panel."""
        content, words = self._content, page_of(self._content, ground, [shot])
        return words | {
            "clock": f"{content.dt * shot.number:.2f} s"
            if content.dt is not None
            else f"{content.counts} {shot.number}",
            "now": [[name, *shot.texts.get(name, ("\u2013", False))] for name in list(content.readouts)],
            "plots": [plot | {"now": number_of(shot, plot["name"])} for plot in words["plots"]],
        }


def _socket(port: int) -> socket.socket:
    """A socket that listens on this machine, on that port or one near it, or on any.

    Raises:
        ViewError: no port is free.
    """
    for tried in [*range(port, port + _PORTS), 0]:
        made = socket.socket()
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            made.setblocking(False)
            made.bind(("127.0.0.1", tried))
            made.listen(16)
        except (OSError, OverflowError) as error:
            made.close()
            refused = error
        else:
            return made
    raise ViewError(f"no port is free: {refused}")


def _matrix(placed: Placement, origin: Array) -> Array:
    """(4, 4) of a body on the stage."""
    matrix: Array = SE3.matrix(np.concatenate([placed.position - origin, placed.attitude]))
    matrix[:3, :3] *= placed.scale
    return matrix
