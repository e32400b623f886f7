"""A scene in Rerun (https://rerun.io): to a file, or to its viewer.

Entities have the names of layers. What stays is static, bodies are meshes under transforms, what changes shape is
logged when it changes and cleared when it ends; a way that grows is logged piece by piece.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import channels
from unifg.typing import Array
from unifg.view.content import Content, Shot
from unifg.view.recording import ground_of, number_of
from unifg.view.shapes import Mesh
from unifg.view.things import MOST, Thing, draw_way

__all__ = ["log_to_rerun"]


class RerunStage:
    """Recording that takes what a stage takes.

    Attributes:
        stroke: half the width of a line that is to be seen well [m].
        static: whether what is drawn stays.
    """

    def __init__(self, rerun: Any, recording: Any, stroke: float) -> None:
        """Draw into a recording of the package ``rerun``."""
        self.stroke, self.static = stroke, False
        self._rr, self._recording = rerun, recording

    def log(self, path: str, *what: Any) -> None:
        """Log components of an entity."""
        self._recording.log(path.split("/"), *what, static=self.static)

    def mesh(self, path: str, mesh: Mesh, colour: str, *, lit: bool = False, opacity: float = 1.0) -> None:
        """Log a mesh in one colour."""
        shade = [*channels(colour), round(255 * opacity)]
        self.log(path, self._rr.Mesh3D(vertex_positions=mesh[0], triangle_indices=mesh[1], albedo_factor=shade))

    def points(self, path: str, points: Array, colour: str, pixels: float) -> None:
        """Log dots (n, 3) [m]."""
        shade, radius = channels(colour), self._rr.Radius.ui_points(0.5 * pixels)
        self.log(path, self._rr.Points3D(points, colors=[shade], radii=[radius]))

    def lines(self, path: str, lines: Array, colour: str) -> None:
        """Log straight lines (n, 2, 3) [m]."""
        shade, radius = channels(colour), self._rr.Radius.ui_points(0.5)
        self.log(path, self._rr.LineStrips3D(lines, colors=[shade], radii=[radius]))


def log_to_rerun(content: Content, path: str | Path | None) -> Any:
    """Log a scene, to a file or to a viewer that is started; return the recording.

    Raises:
        ViewError: nothing is drawn, or rerun-sdk is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise ViewError("scenes in Rerun need the package rerun-sdk: pip install 'unifg[rerun]'") from error
    shots = content.shots or [Shot(0)]
    stage = RerunStage(rr, rr.RecordingStream("unifg"), ground_of(content, shots).stroke)
    recording = stage._recording
    if path is None:
        recording.spawn()
    else:
        recording.save(Path(path))
    stage.static = True
    stage.log("", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    for name, thing in content.things.items():
        thing.put(stage, content.layers[name].path, MOST, content.layers[name])
    for name, body in content.bodies.items():
        for part in body.parts:
            place = f"{content.layers[name].path}/{part.name}"
            stage.mesh(place, part.mesh, part.colour, lit=part.lit, opacity=part.opacity)
    stage.static = False
    known: dict[str, Thing] = {}
    ends: dict[str, Array] = {}
    for k, shot in enumerate(shots):
        if content.dt is None:
            recording.set_time(content.counts, sequence=k)
        else:
            recording.set_time("time", duration=k * content.dt)
        _log_shot(stage, content, shot, k, known, ends)
    recording.flush()
    return recording


def _log_shot(
    stage: RerunStage, content: Content, shot: Shot, k: int, known: dict[str, Thing], ends: dict[str, Array]
) -> None:
    """Log one frame: things that are not as they were, places of bodies, a piece of each growing way, numbers."""
    rr = stage._rr
    for name in known.keys() - shot.things.keys():
        stage.log(content.layers[name].path, rr.Clear(recursive=True))
        del known[name]
    for name, thing in shot.things.items():
        if not thing.same(known.get(name)):
            thing.put(stage, content.layers[name].path, MOST, content.layers[name])
        known[name] = thing
    for name in content.bodies:
        placed, at = shot.placed.get(name), content.layers[name].path
        if placed is None:  # of no size: not seen
            stage.log(at, rr.Transform3D(scale=1e-9))
            continue
        turn = rr.Quaternion(xyzw=np.roll(placed.attitude, -1))
        stage.log(at, rr.Transform3D(translation=placed.position, quaternion=turn, scale=placed.scale))
    for name, place in shot.trails.items():
        before, layer = ends.get(name, place), content.layers[name]
        if not np.array_equal(before, place):
            piece, flat = np.stack([before, place]), content.flat_trails[name]
            draw_way(stage, f"{layer.path}/{k}", 2, layer, points=piece, flat=flat, width=layer.width)
        ends[name] = place
    for name in content.plots:
        value = number_of(shot, name)
        if value is not None:
            stage.log(f"plots/{name}", rr.Scalars(value))
