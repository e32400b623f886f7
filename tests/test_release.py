"""An sdist is the same whoever packs it, and when; what it may weigh is stated."""

from __future__ import annotations

import importlib.util
import io
import tarfile
from types import ModuleType

import pytest

from fences import CHECKOUT


@pytest.fixture(scope="module")
def release() -> ModuleType:
    """The script of `make release-check`."""
    spec = importlib.util.spec_from_file_location("check_release", CHECKOUT / "docs" / "check_release.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
