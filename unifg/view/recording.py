"""A whole scene on a stage: every frame in turn, bodies moved through all of them, ways that grow bit by bit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from unifg.errors import ViewError
from unifg.style.colours import css
from unifg.typing import Array
from unifg.view import shapes, things
from unifg.view.content import Body, Content, Shot
from unifg.view.page import Key, Label, View
from unifg.view.stage import Stage, page_text
from unifg.view.things import Layer, Thing

__all__ = ["Ground", "ground_of", "keys_of", "lay_ground", "number_of", "page_of", "recorded", "set_body"]

FAR = 100.0  # a scene farther from the origin than this many times its size is moved there
STROKE = 0.0022  # half width of lines, over the size of the scene
WATCHED = 40.0  # [s]; a scene starts at the lowest speed that shows it within this time
COUNTED = 0.5  # seconds a frame is shown where frames are merely counted; sums of it are exact, as seeking needs
_HALF = np.array([0.5, 0.5, 0.0])  # around a single place [m]
_AROUND = 0.3  # of the size of what is looked at: how much more a view of everything shows of earlier frames


@dataclass(frozen=True)
class Ground:
    """Extent and centre of a scene.

    Attributes:
        low, high: (3,) corners of everything [m].
        origin: (3,) of the stage [m].
        size: longest edge between the corners [m].
        flat: whether everything lies in the plane.
    """

    low: Array
    high: Array
    origin: Array
    size: float
    flat: bool

    @property
    def stroke(self) -> float:
        """Half width of lines [m]."""
        return STROKE * self.size

    @property
    def corners(self) -> Array:
        """(8, 3) corners on the stage [m]."""
        box = np.stack([self.low, self.high]) - self.origin
        return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)


def recorded(content: Content) -> str:
    """A scene as a page that refers to no other file.

    Raises:
        ViewError: nothing is drawn, or meshcat is not installed.
    """
    shots = content.shots or [Shot(0)]
    ground = ground_of(content, shots)
    dt = COUNTED if content.dt is None else content.dt
    stage = Stage(len(shots), dt, origin=ground.origin, stroke=ground.stroke)
    thinned: dict[str, str] = {}
    for name, thing in content.things.items():
        _draw(stage, content.layers[name], [(0, None, thing)], thinned)
    step = lay_ground(stage, content, ground)
    for name, layer in content.layers.items():
        _draw(stage, layer, _turns(stage, shots, name), thinned)
    for name, body in content.bodies.items():
        _move(stage, content.layers[name], body, shots, name)
    for name, flat in content.flat_trails.items():
        _grow(stage, content.layers[name], shots, name, flat)
    stage.play()
    facts = {
        "grid": f"{step:g} m" if step else "",
        "shown around": f"({', '.join(f'{value:.0f}' for value in ground.origin)}) m" if ground.origin.any() else "",
        **thinned,
    }
    ticks, timed, duration = stage.ticks.tolist(), content.dt is not None, dt * stage.last
    chosen = [shots[tick] for tick in ticks]
    speeds = content.speeds if timed else ()
    fitting = [speed for speed in speeds if speed >= 1.0 and duration / speed <= WATCHED]
    numbers = range(len(shots)) if content.numbers is None else content.numbers
    data = page_of(content, ground, shots, facts)
    plots = data["plots"] if len(shots) > 1 else []
    return page_text(
        data
        | {
            "readouts": [_readout(name, chosen) for name in content.readouts],
            "plots": [plot | {"values": [number_of(shot, plot["name"]) for shot in chosen]} for plot in plots],
            "speeds": speeds,
            "speed": fitting[0] if fitting else speeds[-1] if speeds else 1.0,
            "counts": "time" if timed else content.counts,
            "numbers": [] if timed else [numbers[tick] for tick in ticks],
            "dt": dt,
            "duration": duration,
            "ticks": ticks,
            "step": 0.01 if timed else dt,
            "play": timed,
        },
        stage.recorder.packed_base64(),
    )


def page_of(
    content: Content, ground: Ground, shots: list[Shot], facts: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """Words and views of a page, for its script.

    Args:
        content: of the scene.
        ground: its extent.
        shots: whose things stand in the legend.
        facts: more of them; empty values are left out.
    """
    return {
        "title": content.title,
        "outcome": content.outcome,
        "good": content.good,
        "facts": [[name, text] for name, text in {**content.facts, **facts}.items() if text],
        "legend": [asdict(key) | {"colour": css(key.colour)} for key in keys_of(content, shots)],
        "labels": [_label(label, content, ground) for label in content.labels],
        "views": [asdict(view) for view in content.views or _default_views(content, ground)],
        "corners": ground.corners.round(4).tolist(),
        "plots": [asdict(plot) | {"colour": css(plot.colour)} for plot in list(content.plots.values())],
    }


def keys_of(content: Content, shots: list[Shot]) -> list[Key]:
    """The lines of the legend whose things are there."""
    there = set(content.things)
    for shot in shots:
        there |= shot.things.keys() | shot.placed.keys() | shot.trails.keys()
    keys = [layer.key for name, layer in content.layers.items() if layer.key is not None and name in there]
    return [key for k, key in enumerate(keys) if key not in keys[:k]]


def number_of(shot: Shot, plot: str) -> float | None:
    """Number of a plot in a frame; None where there is none, or no finite one."""
    value = shot.values.get(plot, math.nan)
    return value if math.isfinite(value) else None


def ground_of(content: Content, shots: list[Shot]) -> Ground:
    """Extent of the things of a scene.

    Raises:
        ViewError: there are none.
    """
    last, earlier = _box(content, shots[-1:]), _box(content, shots)
    if earlier is None:
        raise ViewError("nothing is drawn: give families to Scene.of, or draw on the scene or on a frame of it")
    low, high = earlier
    if content.around is not None:
        low, high = content.around.min(axis=0), content.around.max(axis=0)
    elif last is not None and not content.whole:
        reach = _AROUND * float((last[1] - last[0]).max())
        low, high = np.maximum(low, last[0] - reach), np.minimum(high, last[1] + reach)
    size = float((high - low).max())
    flat = float(np.abs([low[2], high[2]]).max()) == 0.0
    if size == 0.0:
        size, low, high = 1.0, low - _HALF, high + _HALF
    far = float(np.abs([low, high]).max()) > FAR * size
    origin = np.round(0.5 * (low + high)) if far else np.zeros(3)
    if flat:
        origin[2] = 0.0
    return Ground(low, high, origin, size, flat)


def lay_ground(stage: Stage, content: Content, ground: Ground) -> float:
    """Draw lines on the ground, unless there is a map; returns their distance [m], 0 for none."""
    if not content.ground or any(thing.draw is things.draw_walls for thing in content.things.values()):
        return 0.0
    decade = 10.0 ** math.floor(math.log10(ground.size / 8.0))
    step = next(decade * k for k in (1.0, 2.0, 5.0, 10.0) if decade * k >= ground.size / 12.0)
    margin = 0.08 * ground.size
    left, low = np.floor((ground.low[:2] - margin) / step) * step
    right, high = np.ceil((ground.high[:2] + margin) / step) * step
    z = min(0.0, float(ground.low[2])) - 0.5 * stage.stroke
    xs, ys = (np.arange(round((b - a) / step) + 1) * step + a for a, b in ((left, right), (low, high)))
    across = [[[x, low, z], [x, high, z]] for x in xs.tolist()]
    along = [[[left, y, z], [right, y, z]] for y in ys.tolist()]
    stage.lines("%grid", np.array(across + along), "grid")
    return float(step)


def set_body(stage: Stage, layer: Layer, body: Body) -> None:
    """Put the meshes of a body on a stage, around its own origin."""
    with stage.around():
        for part in body.parts:
            path = f"{layer.path}/parts/{part.name}"
            stage.mesh(path, part.mesh, part.colour, lit=part.lit, opacity=part.opacity)


def _label(label: Label, content: Content, ground: Ground) -> dict[str, Any]:
    """A label at a place of the stage, and with a path in place of a name."""
    at = None if label.at is None else (np.array(label.at) - ground.origin).tolist()
    follows = None if label.follows is None else content.layers[label.follows].path
    return asdict(label) | {"at": at, "follows": follows}


def _default_views(content: Content, ground: Ground) -> list[View]:
    """From above for what lies in the plane, from the side as well for what does not, and along with each body."""
    above = View("above", "From above", (0.0, -1e-4, 1.0), 20.0)
    slant = (0.0, -math.cos(1.1), math.sin(1.1)) if ground.flat else (0.55, -0.67, 0.5)
    views = [above] if ground.flat else [View("overview", "Overview", slant, 20.0), above]
    for name, body in content.bodies.items():
        distance = max(25.0 * body.reach, 0.5 * ground.size)
        views.append(View(f"follow {name}", f"Follow {name}", slant, 20.0, name, distance))
    return views


def _box(content: Content, shots: list[Shot]) -> tuple[Array, Array] | None:
    """Corners of everything that some frames hold, and of what stays; None of nothing."""
    parts = [thing.corners for thing in content.things.values()]
    for shot in shots:
        parts += [thing.corners for thing in shot.things.values()]
        parts += [place[None] for place in shot.trails.values()]
        for name, placed in shot.placed.items():
            reach = content.bodies[name].reach * float(np.abs(placed.scale).max())
            lift = 0.0 if placed.position[2] == 0.0 else reach
            arm = np.array([reach, reach, lift])
            parts.append(np.stack([placed.position - arm, placed.position + arm]))
    parts = [part for part in parts if len(part)]
    if not parts:
        return None
    return np.min([part.min(axis=0) for part in parts], axis=0), np.max([part.max(axis=0) for part in parts], axis=0)


def _turns(stage: Stage, shots: list[Shot], name: str) -> list[tuple[int, int | None, Thing]]:
    """Things of a layer, each from a tick to another; equal ones are one thing."""
    runs: list[tuple[int, int | None, Thing]] = []
    for tick, following in stage.turns():
        thing = shots[tick].things.get(name)
        if thing is None:
            continue
        if runs and runs[-1][1] == tick and thing.same(runs[-1][2]):
            runs[-1] = (runs[-1][0], following, runs[-1][2])
        else:
            runs.append((tick, following, thing))
    return runs


def _draw(stage: Stage, layer: Layer, runs: list[tuple[int, int | None, Thing]], thinned: dict[str, str]) -> None:
    members = [thing.members for _, _, thing in runs]
    if not members:
        return
    budget = runs[0][2].budget
    most = max(members) if sum(members) <= budget else max(2, budget // len(members))
    if most < max(members):
        thinned[f"{layer.path}, thinned"] = f"{most} of {max(members)}"
    for begin, end, thing in runs:
        always = begin == 0 and end is None
        path = layer.path if always else f"{layer.path}/{begin}"
        thing.put(stage, path, most, layer)
        if not always:
            stage.appear(path, begin, end)


def _move(stage: Stage, layer: Layer, body: Body, shots: list[Shot], name: str) -> None:
    """Animate a body; where it is not placed it is not seen."""
    if not any(name in shots[tick].placed for tick in stage.ticks):
        return
    set_body(stage, layer, body)
    ticks = stage.ticks.tolist()
    there = [(tick, placed) for tick in ticks if (placed := shots[tick].placed.get(name)) is not None]
    _animate(stage, layer.path, [(tick, {"position": placed.position}) for tick, placed in there])
    _animate(stage, layer.path, [(tick, {"quaternion": placed.attitude}) for tick, placed in there])
    if any(bool((placed.scale != 1.0).any()) for _, placed in there):
        scales = [(tick, {"scale": np.maximum(placed.scale, 1e-9)}) for tick, placed in there]
        _animate(stage, f"{layer.path}/parts", scales)
    if len(there) < len(ticks):
        seen = [name in shots[tick].placed for tick in ticks]
        _animate(stage, f"{layer.path}/parts", [(t, {"visible": v}) for t, v in zip(ticks, seen, strict=True)], True)


def _animate(stage: Stage, path: str, keys: list[tuple[int, dict[str, Any]]], sudden: bool = False) -> None:
    """Animate one property, without the keys that say nothing: it stood as it is, and stays so.

    What stands still for a while needs a key at its end, or it would creep to the next one.
    """
    values = [np.asarray(next(iter(given.values()))) for _, given in keys]
    for k, (tick, given) in enumerate(keys):
        inner = 0 < k < len(keys) - 1
        stood = inner and np.array_equal(values[k], values[k - 1])
        if not (stood and (sudden or np.array_equal(values[k], values[k + 1]))):
            stage.key(path, tick, **given)


def _grow(stage: Stage, layer: Layer, shots: list[Shot], name: str, flat: bool) -> None:
    for begin, end in stage.pieces():
        places = [shot.trails[name] for shot in shots[begin : end + 1] if name in shot.trails]
        points = shapes.thin(np.array(places), 3) if len(places) > 1 else np.zeros((0, 3))
        if len(points) > 1:
            path = f"{layer.path}/{begin}"
            things.draw_way(stage, path, len(points), layer, points=points, flat=flat, width=layer.width)
            stage.appear(path, end)


def _readout(name: str, shots: list[Shot]) -> dict[str, Any]:
    """A line of the panel: one text per frame, and which of them are alarms."""
    rows = [shot.texts.get(name, ("\u2013", False)) for shot in shots]
    return {"name": name, "texts": [text for text, _ in rows], "alarms": [alarm for _, alarm in rows]}
