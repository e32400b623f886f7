"""Occupancy maps in the ROS map format: one YAML file beside one image (PGM, PNG, ...).

Format: http://wiki.ros.org/map_server#Map_format. The origin is the pose of the lower-left pixel's lower-left
corner, while image row 0 is the top: rows are flipped on load, so that row 0 of every array here is the
lowest y. A pixel of value v (colours averaged) is occupied with p = (255 - v) / 255, or v / 255 when
``negate`` is set; p above ``occupied_thresh`` is occupied, p below ``free_thresh`` is free, anything else is
unknown, which is neither.
"""

from __future__ import annotations

import json
import logging
import math
import reprlib
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from unifg.atomic_write import write_atomically
from unifg.errors import FileFormatError, ModelError
from unifg.files.contents import LIMITS, Limits, legible, read_text
from unifg.typing import Array, BoolArray

logger = logging.getLogger("unifg")

_KEYS = ("image", "resolution", "origin", "occupied_thresh", "free_thresh", "negate", "mode")
_DEFAULT_OCCUPIED, _DEFAULT_FREE = 0.65, 0.196
# Values of ROS's own map_saver; 205 lies between the default thresholds.
_WIDEST = 1e6  # of a map [m]
_LONGEST = 255  # name of a file, on the systems there are
_pillow = Lock()  # its limit of pixels is one for all threads
_PIXEL_OCCUPIED, _PIXEL_FREE, _PIXEL_UNKNOWN = 0, 254, 205


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Cells known to be occupied and cells known to be free; the rest is unknown.

    Attributes:
        occupied: (H, W) bool, row 0 at the lowest y of the map's own frame.
        free: (H, W) bool; a cell that is neither occupied nor free is unknown.
        resolution: side of a cell [m].
        origin: pose (x, y, yaw) [m, m, rad] in the world of the lower-left corner of cell [0, 0].
        name: the name of the file, without its ending.
    """

    occupied: BoolArray
    free: BoolArray
    resolution: float
    origin: tuple[float, float, float]
    name: str = "map"

    def __post_init__(self) -> None:
        """Refuse masks and numbers that cannot be a map.

        Raises:
            ModelError: masks are no boolean arrays, shapes differ, a cell is both occupied and free, or a number is
                not usable.
        """
        kinds = [(str(getattr(mask, "dtype", "no array")), np.shape(mask)) for mask in (self.occupied, self.free)]
        if kinds[0] != kinds[1] or kinds[0][0] != "bool" or self.occupied.ndim != 2 or self.occupied.size == 0:
            raise ModelError(
                f"map {self.name!r}: occupied, {kinds[0]}, and free, {kinds[1]}, must be bool arrays (H, W) of one "
                "shape; numbers would be taken for indices"
            )
        if np.any(self.occupied & self.free):
            raise ModelError(f"map {self.name!r}: some cells are both occupied and free")
        if not (math.isfinite(self.resolution) and self.resolution > 0.0):
            raise ModelError(f"map {self.name!r}: resolution {self.resolution!r} must be positive [m]")
        if len(self.origin) != 3 or not all(math.isfinite(value) for value in self.origin):
            raise ModelError(f"map {self.name!r}: origin {self.origin!r} must be finite (x, y, yaw)")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns (H, W)."""
        return self.occupied.shape[0], self.occupied.shape[1]

    @property
    def bounds(self) -> Array:
        """Corners of the map in the world, (4, 2) [m], counter-clockwise from the origin."""
        height, width = self.shape
        corners = [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]
        return self.grid_to_world(np.array(corners, dtype=np.float64))

    def world_to_grid(self, points: Array) -> Array:
        """Continuous grid coordinates of world points; cell [i, j] covers columns [j, j+1) and rows [i, i+1).

        Args:
            points: (..., 2) [m].

        Returns:
            (..., 2) column and row [cells].
        """
        return (np.asarray(points, dtype=np.float64) - self.origin[:2]) @ self._rotation() / self.resolution

    def grid_to_world(self, coordinates: Array) -> Array:
        """World points of continuous grid coordinates: the inverse of `world_to_grid`.

        Args:
            coordinates: (..., 2) column and row [cells]; the centre of cell [i, j] is (j + 0.5, i + 0.5).

        Returns:
            (..., 2) [m].
        """
        scaled = np.asarray(coordinates, dtype=np.float64) * self.resolution
        return scaled @ self._rotation().T + self.origin[:2]

    def _rotation(self) -> Array:
        """world_R_map; a row vector times it goes from the world to the map."""
        c, s = math.cos(self.origin[2]), math.sin(self.origin[2])
        return np.array([[c, -s], [s, c]])


def load_map(path: str | Path, limits: Limits = LIMITS) -> OccupancyMap:
    """Read a map from its YAML file and the image named in it.

    Modes ``trinary`` (the default) and ``scale`` are read; both give the same three classes here, because the
    grey levels that ``scale`` keeps between the thresholds are neither occupied nor free. Mode ``raw``
    (pixels are cost values, thresholds are ignored) is not supported. Transparency is ignored, except that a
    fully transparent pixel is unknown. One warning names other keys than those of a map, such as a misspelt one.

    Args:
        path: the YAML file.
        limits: of what it and its image may hold.

    Returns:
        The map, with row 0 at the bottom and the file's stem as its name.

    Raises:
        FileFormatError: the YAML file or its image is missing, unreadable, or says something impossible.
    """
    path = Path(path)
    name, header = legible(path), _read_header(path, limits)
    resolution = _number(name, header, "resolution", None)
    if resolution <= 0.0:
        raise FileFormatError(f"{name}: resolution is {resolution}; it must be positive [m]")
    origin = _origin(name, header)
    occupied_threshold = _number(name, header, "occupied_thresh", _DEFAULT_OCCUPIED)
    free_threshold = _number(name, header, "free_thresh", _DEFAULT_FREE)
    if not 0.0 <= free_threshold <= occupied_threshold <= 1.0:
        raise FileFormatError(
            f"{name}: free_thresh {free_threshold} and occupied_thresh {occupied_threshold} must satisfy "
            "0 <= free_thresh <= occupied_thresh <= 1"
        )
    mode = header.get("mode", "trinary")
    mode = mode.lower() if isinstance(mode, str) else reprlib.repr(mode)
    if mode == "raw":
        raise FileFormatError(f"{name}: mode 'raw' is not supported; save the map again in mode 'trinary'")
    if mode not in ("trinary", "scale"):
        raise FileFormatError(f"{name}: unknown mode {mode!r}; expected 'trinary' or 'scale'")
    if header.get("negate", 0) not in (0, 1):  # True and False compare equal to 1 and 0
        raise FileFormatError(f"{name}: negate is {reprlib.repr(header['negate'])}; it must be 0 or 1")

    image = header.get("image")
    if not isinstance(image, str) or not image:
        raise FileFormatError(f"{name}: 'image' is {reprlib.repr(image)}; it must name the image beside the YAML file")
    if max(map(len, image.split("/"))) > _LONGEST:
        raise FileFormatError(f"{name}: 'image' is {reprlib.repr(image)}; no file has so long a name")
    grey, visible = _read_image(name, path.parent / image, limits)
    width = resolution * max(grey.shape)
    if width > _WIDEST or max(map(abs, origin)) > 1e12 * resolution or abs(origin[2]) > 2.0 * math.pi:
        raise FileFormatError(
            f"{name}: {grey.shape[1]} x {grey.shape[0]} cells of {resolution:g} m at {origin} are no map of a place; "
            "the resolution is the side of a cell [m], and the origin is x, y [m] and yaw [rad], a turn at the most"
        )
    probability = (grey if header.get("negate", 0) else 255.0 - grey) / 255.0
    return OccupancyMap(
        occupied=np.ascontiguousarray(((probability > occupied_threshold) & visible)[::-1]),
        free=np.ascontiguousarray(((probability < free_threshold) & visible)[::-1]),
        resolution=resolution,
        origin=origin,
        name=path.stem,
    )


def save_map(path: str | Path, occupancy: OccupancyMap) -> None:
    """Write a map as a YAML file and a binary PGM (P5) of the same stem; `load_map` reads the same map back.

    Args:
        path: the YAML file; the image goes beside it, and the name read back is the stem of this path.
        occupancy: the map.
    """
    path = Path(path)
    pixels = np.full(occupancy.shape, _PIXEL_UNKNOWN, dtype=np.uint8)
    pixels[occupancy.free] = _PIXEL_FREE
    pixels[occupancy.occupied] = _PIXEL_OCCUPIED
    height, width = occupancy.shape
    image = path.with_suffix(".pgm")
    write_atomically(image, f"P5\n{width} {height}\n255\n".encode("ascii") + pixels[::-1].tobytes())
    x, y, yaw = (float(value) for value in occupancy.origin)
    write_atomically(
        path,
        f"image: {json.dumps(image.name, ensure_ascii=False)}\nmode: trinary\n"
        f"resolution: {_yaml_float(occupancy.resolution)}\n"
        f"origin: [{_yaml_float(x)}, {_yaml_float(y)}, {_yaml_float(math.remainder(yaw, math.tau))}]\nnegate: 0\n"
        f"occupied_thresh: {_DEFAULT_OCCUPIED}\nfree_thresh: {_DEFAULT_FREE}\n",
    )


def _yaml_float(value: float) -> str:
    """The shortest exact decimal that YAML 1.1 reads as a number (1.0e-05, not 1e-05)."""
    text = repr(float(value))
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def _read_header(path: Path, limits: Limits) -> dict[str, Any]:
    try:
        import yaml
    except ImportError as error:
        raise ImportError("reading a ROS map needs PyYAML: pip install 'unifg[scenarios]'") from error
    name = legible(path)
    try:
        text = read_text(path, limits)
    except FileFormatError as error:
        raise FileFormatError(f"{error}; give the YAML file of a ROS map, not its image") from error
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > limits.depth or isinstance(event, yaml.AliasEvent):
                what = "nested too deeply" if depth > limits.depth else "an alias, of which a map has none"
                raise FileFormatError(f"{name}, line {event.start_mark.line + 1 if event.start_mark else 1}: {what}")
        header = yaml.safe_load(text)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        keys = [key.value for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
        if twice := [key for k, key in enumerate(keys) if key in keys[:k]]:
            raise FileFormatError(f"{name}: the key {twice[0]!r} is given twice")
    except FileFormatError:
        raise
    except Exception as error:  # beside its own, PyYAML lets out what dates, numbers and tags that are none raise
        kind = "" if isinstance(error, yaml.YAMLError) else f"{type(error).__name__}: "
        raise FileFormatError(f"{name}: not readable as YAML ({kind}{error})") from error
    if not isinstance(header, dict):
        found = reprlib.repr(header)
        raise FileFormatError(f"{name}: expected lines 'key: value' (image, resolution, ...), found {found}")
    for key in ("image", "resolution", "origin"):
        if key not in header:
            raise FileFormatError(f"{name}: the key {key!r} is missing; a map needs image, resolution, origin")
    if unread := [legible(str(key)) for key in header if key not in _KEYS]:
        logger.warning("%s: keys that are not read: %s; those of a map: %s", name, unread, ", ".join(_KEYS))
    return header


def _number(name: str, header: dict[str, Any], key: str, default: float | None) -> float:
    value = _to_float(header.get(key, default))
    if value is None:
        raise FileFormatError(f"{name}: {key} is {reprlib.repr(header[key])}; it must be a finite number")
    return value


def _origin(name: str, header: dict[str, Any]) -> tuple[float, float, float]:
    entries = header["origin"]
    values = [_to_float(entry) for entry in entries] if isinstance(entries, list) else []
    numbers = [value for value in values if value is not None]
    if len(values) != 3 or len(numbers) != 3:
        raise FileFormatError(
            f"{name}: origin is {reprlib.repr(entries)}; it must be [x, y, yaw] in metres and radians"
        )
    return numbers[0], numbers[1], numbers[2]


def _to_float(value: object) -> float | None:
    """A finite number, or None; YAML 1.1 leaves numbers such as 5e-2 as text, hence the str."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _read_image(name: str, image: Path, limits: Limits) -> tuple[Array, BoolArray]:
    """Grey values (H, W) in 0..255, top row first, and which pixels are not fully transparent."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise ImportError("reading a map's image needs Pillow: pip install 'unifg[scenarios]'") from error
    where = f"{legible(image)} (named in {name})"
    try:
        with _opened(Image, image) as picture:
            kind, (width, height) = picture.mode, picture.size
            if width * height > limits.pixels:
                raise FileFormatError(f"{where}: {width} x {height} pixels: limits=Limits(pixels=...) reads more")
            if kind not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
                raise FileFormatError(f"{where}: pixel kind {kind!r}; save as 8-bit grey or RGB")
            pixels = np.asarray(picture.convert("RGBA"), dtype=np.uint8)
    except FileFormatError:
        raise
    except FileNotFoundError as error:
        raise FileFormatError(f"{name}: the image {legible(image)} does not exist; put it beside the YAML") from error
    except UnidentifiedImageError as error:
        raise FileFormatError(f"{where}: not an image that Pillow can read") from error
    except Exception as error:  # Pillow's readers let out whatever a damaged image makes them stumble over
        raise FileFormatError(f"{where}: damaged image ({type(error).__name__}: {error})") from error
    return pixels[..., :3].sum(axis=-1, dtype=np.int64) / 3.0, pixels[..., 3] > 0


def _opened(pillow: Any, path: Path) -> Any:
    """An image whose size nobody has judged yet."""
    with _pillow:
        most, pillow.MAX_IMAGE_PIXELS = pillow.MAX_IMAGE_PIXELS, None
        try:
            return pillow.open(path)
        finally:
            pillow.MAX_IMAGE_PIXELS = most
