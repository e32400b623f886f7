"""Reads the page of a scene back: what its script knows, and the commands to its viewer."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import pytest

from unifg.view.recorder import viewer_script

Commands = list[dict[str, Any]]
Tracks = dict[str, dict[str, list[tuple[int, Any]]]]


def without_viewer(page: str) -> str:
    """The page around the viewer, which stands in it once."""
    script = viewer_script()
    assert page.count(script) == 1
    return page.replace(script, "")


def data_of(page: str) -> dict[str, Any]:
    """Data in the script of a page."""
    found = re.search(r"^const DATA = (.*);$", page, re.MULTILINE)
    assert found
    data: dict[str, Any] = json.loads(found.group(1))
    return data


def commands_of(page: str) -> Commands:
    """Everything sent to the viewer."""
    umsgpack = pytest.importorskip("umsgpack")
    found = re.search(r"^const COMMANDS = (\[.*?\]);$", page, re.DOTALL | re.MULTILINE)
    assert found
    return [umsgpack.unpackb(base64.b64decode(text)) for text in json.loads(found.group(1))]


def tracks_of(commands: Commands) -> Tracks:
    """Path below /meshcat/ to property to keys (frame, value)."""
    tracks: Tracks = {}
    for animation in commands[-1]["animations"]:
        for track in animation["clip"]["tracks"]:
            keys = [(key["time"], key["value"]) for key in track["keys"]]
            tracks.setdefault(animation["path"].removeprefix("/meshcat/"), {})[track["name"]] = keys
    return tracks


def check_offline(page: str) -> None:
    """Nothing in the page asks for another file or connection."""
    around = without_viewer(page)
    assert re.findall(r"(?:https?:)?//[\w.-]+\.\w+", re.sub(r'"[A-Za-z0-9+/=\s]{40,}"', "", around)) == []
    for word in (" src=", "href=", "@import", "url(", "fetch(", "import(", "WebSocket", ".connect("):
        assert word not in around
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy and "default-src 'none'" in policy.group(1)
    assert "http" not in policy.group(1) and "connect-src" not in policy.group(1)
    assert "@@" not in around
