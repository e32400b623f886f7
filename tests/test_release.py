"""An sdist is the same whoever packs it, and when; what it may weigh is stated; what was not tried is said."""

from __future__ import annotations

import io
import sys
import tarfile
from pathlib import Path
from types import ModuleType

import pytest

from scripts import CHECKOUT, loaded


@pytest.fixture(scope="module")
def release() -> ModuleType:
    """The script of `make release-check`."""
    return loaded(CHECKOUT / "docs" / "check_release.py")


def packed(names: list[str], when: int, who: str, mode: int) -> bytes:
    """An archive of small files."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size, member.mtime, member.uname, member.mode = 3, when, who, mode
            archive.addfile(member, io.BytesIO(name[:3].encode()))
    return out.getvalue()


def test_archives_are_evened(release: ModuleType) -> None:
    first = release.evened(packed(["unifg/a", "unifg/b"], 1, "me", 0o600), 1000)
    second = release.evened(packed(["unifg/b", "unifg/a"], 2, "you", 0o664), 1000)
    assert first == second
    with tarfile.open(fileobj=io.BytesIO(first)) as archive:
        members = archive.getmembers()
        assert [(m.name, m.mtime, m.uname, m.mode) for m in members] == [
            ("unifg/a", 1000, "", 0o644), ("unifg/b", 1000, "", 0o644),
        ]  # fmt: skip
        content = archive.extractfile("unifg/a")
        assert content is not None and content.read() == b"uni"
    assert release.evened(packed(["unifg/a"], 1, "me", 0o755), 1000) != release.evened(
        packed(["unifg/a"], 1, "me", 0o644), 1000
    )


def test_sizes_are_stated(release: ModuleType) -> None:
    assert 1.0 < release.allowed("wheel") < release.allowed("sdist")
    with pytest.raises(SystemExit, match="does not say"):
        release.allowed("disc")


def test_sizes_are_kept(release: ModuleType) -> None:
    allowed = {
        "unifg-1.whl": int(1e6 * release.allowed("wheel")),
        "unifg-1.tar.gz": int(1e6 * release.allowed("sdist")),
    }
    assert list(release.too_large(allowed)) == []
    (said,) = release.too_large(allowed | {"unifg-1.whl": allowed["unifg-1.whl"] + 1})
    assert said.startswith("unifg-1.whl has")
    (said,) = release.too_large(allowed | {"unifg-1.tar.gz": allowed["unifg-1.tar.gz"] + 1})
    assert said.startswith("unifg-1.tar.gz has")


def test_a_python_has_to_start_and_be_of_the_version(release: ModuleType, tmp_path: Path) -> None:
    """Shims of version managers are on the path and start nothing; the path may name another version."""
    shim = tmp_path / "python"
    shim.write_text("#!/bin/sh\necho not installed >&2\nexit 127\n")
    shim.chmod(0o755)
    mine = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert release.interpreter(mine, [str(tmp_path / "none"), str(shim), sys.executable]) == sys.executable
    assert release.interpreter("3.1", [sys.executable]) is None
    assert mine in release.named() or sys.version_info > (3, 13)


BOTH = ["newest", "lowest"]


@pytest.mark.parametrize(
    ("ends", "cases", "code"),
    [
        ({}, BOTH, 0),
        ({"3.12-lowest": "no wheels"}, BOTH, 0),
        ({"3.12-newest": "no wheels"}, BOTH, 1),
        ({"3.11-lowest": "no wheels"}, BOTH, 1),  # of the oldest Python there have to be: a bound that nobody published
        ({"3.11-lowest": "red"}, BOTH, 1),
        ({"3.11-lowest": "red"}, ["newest"], 0),
        ({"3.11-newest": "red"}, ["lowest"], 0),
    ],
)
def test_what_fails_and_what_is_not_there(
    release: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    ends: dict[str, str],
    cases: list[str],
    code: int,
) -> None:
    """Only the lowest packages of later Pythons may be without wheels; everything that was not tried is said."""
    words = {"no wheels": "ERROR: No matching distribution found for numpy==1.26", "red": "1 failed"}

    def trial(_wheel: Path, _sdist: Path, _python: str, home: Path, _lowest: bool) -> str:
        home.mkdir()
        if home.name in ends:
            raise release.Failed(words[ends[home.name]])
        return "fine"

    monkeypatch.setattr(release, "trial", trial)
    monkeypatch.setattr(release, "interpreter", lambda minor, among: None if minor == "3.13" else "python")
    assert release.installed(tmp_path, tmp_path, tmp_path, ["3.11", "3.12", "3.13"], cases) == code
    said = capsys.readouterr().out
    assert "Python 3.13: NOT TRIED" in said
    assert ("3.12 with the lowest packages: NOT TRIED" in said) == ("3.12-lowest" in ends)
    assert ("failed: " in said) == (code == 1)


def test_a_wheel_that_was_tried_nowhere_is_not_passed(
    release: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(release, "interpreter", lambda minor, among: None)
    assert release.installed(tmp_path, tmp_path, tmp_path, ["3.11"], BOTH) == 1
