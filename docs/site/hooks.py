"""Hooks of mkdocs: pages that are made join those that are written (:mod:`reference` beside this file)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).resolve().parent))

import reference


def on_config(config: Any) -> Any:
    """List the reference in the navigation."""
    (place,) = (item for item in config.nav if "Reference" in item)
    place["Reference"] = ["api/index.md", *({module: f"api/{module}.md"} for module in reference.public())]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add what is made."""
    for name, text in reference.pages().items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lead links out of the folder to what stands for those files here."""
    for outside, inside in reference.MOVED.items():
        markdown = markdown.replace(outside, inside)
    return markdown
