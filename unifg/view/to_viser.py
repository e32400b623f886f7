"""A scene served by viser (https://viser.studio), with a slider for the frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import channels
from unifg.typing import Array
from unifg.view.content import Content, Shot
from unifg.view.paper import draw_shot
from unifg.view.recording import ground_of
from unifg.view.shapes import Mesh
from unifg.view.things import MOST

__all__ = ["serve_by_viser"]

_DOT = 0.6  # size of dots, over half the width of a line and pixel


class ViserStage:
    """Scene of viser that takes what a stage takes.

    Attributes:
        stroke: half the width of a line that is to be seen well [m].
        sent: handles of what was drawn, to be taken away.
    """

    def __init__(self, scene: Any, stroke: float) -> None:
        """Draw into the scene of a server."""
        self.stroke, self._scene = stroke, scene
        self.sent: list[Any] = []

    def mesh(self, path: str, mesh: Mesh, colour: str, *, lit: bool = False, opacity: float = 1.0) -> None:
        """Send a mesh in one colour."""
        look: dict[str, Any] = {"flat_shading": True, "side": "double", "cast_shadow": False}
        self._keep(
            "add_mesh_simple", path, *mesh, color=channels(colour), opacity=opacity if opacity < 1.0 else None, **look
        )

    def points(self, path: str, points: Array, colour: str, pixels: float) -> None:
        """Send dots (n, 3) [m]."""
        self._keep("add_point_cloud", path, points, channels(colour), point_size=_DOT * pixels * self.stroke)

    def lines(self, path: str, lines: Array, colour: str) -> None:
        """Send straight lines (n, 2, 3) [m]."""
        self._keep("add_line_segments", path, lines, channels(colour))

    def _keep(self, add: str, path: str, *given: Any, **options: Any) -> None:
        self.sent.append(getattr(self._scene, add)(f"/{path}", *given, **options))


def serve_by_viser(content: Content, port: int) -> Any:
    """Serve a scene and return the server; ``server.stop()`` ends it.

    Raises:
        ViewError: nothing is drawn, or viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ViewError("scenes in viser need the package viser: pip install 'unifg[viser]'") from error
    shots = content.shots or [Shot(0)]
    ground = ground_of(content, shots)
    server: Any = viser.ViserServer(host="127.0.0.1", port=port, label=content.title, verbose=False)
    still, moving = ViserStage(server.scene, ground.stroke), ViserStage(server.scene, ground.stroke)
    server.scene.configure_environment_map(None)  # which makes colours pale
    server.scene.add_light_ambient("/ambient", intensity=1.6)
    for name, thing in content.things.items():
        thing.put(still, content.layers[name].path, MOST, content.layers[name])
    centre = 0.5 * (ground.low + ground.high)
    server.initial_camera.look_at = centre
    server.initial_camera.position = centre + ground.size * np.array([0.05, -0.55, 0.6])
    slider = server.gui.add_slider(content.counts, 0, max(1, len(shots) - 1), 1, 0)

    def show(_: object = None) -> None:
        k = min(int(slider.value), len(shots) - 1)
        old, moving.sent = moving.sent, []
        with server.atomic():
            for handle in old:
                handle.remove()
            draw_shot(moving, content, shots[: k + 1])

    slider.on_update(show)
    show()
    return server
