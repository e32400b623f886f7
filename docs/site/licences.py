"""Licences of all that unifg needs or can use: `python docs/site/licences.py` rewrites docs/reference/licences.md.

Read from the metadata of what is installed, dependencies of dependencies included as far as this platform needs them;
run it where all extras are.
"""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

CHECKOUT = Path(__file__).resolve().parent.parent.parent
PAGE = CHECKOUT / "docs" / "reference" / "licences.md"
# Extras; those for tests, style and this site stay with us.
USED = ("view", "scenarios", "casadi", "campaign", "mcap", "metis", "mujoco", "rerun", "viser", "bench")
HEAD = """# Licences

unifg itself is under the [MIT licence](../../LICENSE). It contains no code of others; scenes carry meshcat's viewer
inside (MIT), with three.js (MIT). What it needs, what its extras add, and what these need in turn on Linux, as the
metadata of the packages says; the page is made by `python docs/site/licences.py`.

| package | version | licence | for |
|---|---|---|---|
"""
NAME = re.compile(r"[A-Za-z0-9._-]+")


def plain(name: str) -> str:
    """A package's name as indices spell it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def stated() -> dict[str, str]:
    """Packages that pyproject.toml names, and what for."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = {}
    for purpose in reversed(USED):
        for requirement in project["optional-dependencies"][purpose]:
            name = _name(requirement)
            if name != "unifg":
                found[name] = f"`unifg[{purpose}]`"
    return found | {_name(requirement): "unifg" for requirement in project["dependencies"]}


def closure() -> dict[str, str]:
    """These, and what they need here; what happens to be installed for others' sake is not among them.

    Raises:
        SystemExit: when something of it is not installed: the page would leave it out.
    """
    found, waiting, missing = dict[str, str](), [(name, purpose) for name, purpose in stated().items()], set[str]()
    waiting.sort(key=lambda pair: pair[1] != "unifg")
    while waiting:
        name, purpose = waiting.pop(0)
        if name in found:
            continue
        try:
            needed = [Requirement(one) for one in metadata.requires(name) or []]
        except metadata.PackageNotFoundError:
            missing.add(name)
            continue
        found[name] = purpose
        waiting += [
            (plain(one.name), purpose) for one in needed if one.marker is None or one.marker.evaluate({"extra": ""})
        ]
    if missing:
        raise SystemExit(
            f"{', '.join(sorted(missing))}: not installed here, so nothing is known of their licences. "
            f"Install all extras: pip install -e '.[{','.join(USED)}]'"
        )
    return found


def licence(name: str) -> str:
    """Licence in the metadata of a package: the expression, the classifier, the first words of the field."""
    about = metadata.metadata(name)
    if "License-Expression" in about:
        return str(about["License-Expression"])
    classified = [c.rpartition("::")[2].strip() for c in about.get_all("Classifier") or [] if c.startswith("License")]
    said = [c for c in classified if c != "OSI Approved"]
    if said:
        return ", ".join(said)
    field = (about["License"] if "License" in about else "").strip().split("\n")[0]
    return field[:60] or "unknown"


def text() -> str:
    """The page."""
    rows = [
        f"| {name} | {metadata.version(name)} | {licence(name)} | {purpose} |" for name, purpose in closure().items()
    ]
    return HEAD + "\n".join(sorted(rows)) + "\n"


def _name(requirement: str) -> str:
    found = NAME.match(requirement)
    assert found is not None
    return plain(found[0])


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8", newline="\n")
    print(PAGE)
