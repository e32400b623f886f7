"""The documentation is true: every block of code runs, every link leads somewhere."""

import re
import shutil
import subprocess
import sys
import traceback
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

from fences import PYTHON, SHELL, SHOWN, Fence, documents, fences, relative
from scripts import CHECKOUT, files_in_git

PAGES = documents()
# Reasons that have been agreed to. A skip with any other reason fails.
ALLOWED_SKIPS: frozenset[str] = frozenset()

_LINK = re.compile(r"!?\[[^\]]*\]\(\s*<?(?P<target>[^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
_REFERENCE = re.compile(r"^\s*\[[^\]]+\]:\s*<?(?P<target>[^\s>]+)", re.MULTILINE)
_HTML = re.compile(r"\b(?:src|href)=\"(?P<target>[^\"]+)\"")


def run_page(blocks: list[Fence], monkeypatch: pytest.MonkeyPatch) -> None:
    """Execute blocks in order in one namespace; fail with the file and line of the block that raised."""
    module = ModuleType("__main__")  # so that dataclasses, and `if __name__ == "__main__"`, work as in a script
    monkeypatch.setitem(sys.modules, "__main__", module)
    for block in blocks:
        # Blank lines in front make every traceback show the line of the page itself.
        source = "\n" * (block.line - 1) + block.code
        try:
            exec(compile(source, str(block.path), "exec"), module.__dict__)
        except Exception as error:
            where = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(block.path)]
            line = error.lineno if isinstance(error, SyntaxError) else where[-1] if where else block.line
            trace = "".join(traceback.format_exception(error))
            pytest.fail(
                f"{relative(block.path)}:{line}: {type(error).__name__}: {error}\n"
                f"(in the block that starts at {block.place})\n{trace}",
                pytrace=False,
            )


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, and pictures drawn without a screen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    monkeypatch.setattr(plt, "show", lambda *args, **kwargs: None)
    return tmp_path


def python_blocks(page: Path) -> list[Fence]:
    """Blocks of a page that are run."""
    return [f for f in fences(page) if f.language in PYTHON and f.skip is None]


@pytest.mark.parametrize("page", [page for page in PAGES if python_blocks(page)], ids=relative)
@pytest.mark.product(2)
def test_python_blocks_run(page: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = python_blocks(page)
    for peer in ("casadi", "gtsam"):  # extras that the tests do not ask for
        if find_spec(peer) is None:
            blocks = [f for f in blocks if not f.code.startswith(f"import {peer}")]
    run_page(blocks, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_no_block_hides(page: Path) -> None:
    for fence in fences(page):
        assert fence.language in PYTHON | SHELL | SHOWN, (
            f"{fence.place}: language '{fence.language}' is neither run nor known to be shown only; "
            f"use one of {', '.join(sorted(PYTHON | SHELL | SHOWN))}"
        )
        assert fence.skip is None or fence.skip in ALLOWED_SKIPS, f"{fence.place}: skipped ({fence.skip})"


def link_targets(text: str) -> set[str]:
    """Find what a page links to, outside its code."""
    prose = re.sub(r"^([ \t]*)(`{3,}|~{3,}).*?^\s*\2", "", text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"`[^`\n]*`", "", prose)
    return {m["target"] for pattern in (_LINK, _REFERENCE, _HTML) for m in pattern.finditer(prose)}


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings as GitHub makes them."""
    prose = re.sub(
        r"^([ \t]*)(`{3,}|~{3,}).*?^\s*\2",
        "",
        page.read_text(encoding="utf-8"),
        flags=re.MULTILINE | re.DOTALL,
    )
    names: set[str] = set()
    for heading in re.findall(r"^#{1,6}\s+(.+?)\s*#*\s*$", prose, flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        base = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        name, count = base, 0
        while name in names:
            count += 1
            name = f"{base}-{count}"
        names.add(name)
    return names


def broken_links(page: Path) -> list[str]:
    """List the relative links of a page that lead nowhere."""
    root = next((folder.parent for folder in page.resolve().parents if folder.name == "docs"), page.resolve().parent)
    broken = []
    for target in sorted(link_targets(page.read_text(encoding="utf-8"))):
        if re.match(r"^[a-z][a-z0-9+.-]*:", target):  # https:, mailto:
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if (
            not file.exists()
            or not file.is_relative_to(root)
            or (anchor and file.suffix == ".md" and anchor.lower() not in anchors(file))
        ):
            broken.append(target)
    return broken


@pytest.mark.parametrize("page", [*PAGES, *[p for p in [CHECKOUT / "CHANGELOG.md"] if p.is_file()]], ids=relative)
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


def test_the_changelog_is_short() -> None:
    """A section that grows with every change is read by none: what it gains takes the place of something."""
    sections = re.split(r"^## ", (CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    lines = {section.partition("\n")[0]: len(section.strip().splitlines()) for section in sections}
    assert lines and max(lines.values()) <= 120, lines


def test_linked_files_are_in_git() -> None:
    """A link to a file that only exists on the author's disk is broken for everybody else."""
    known = {path.resolve() for path in files_in_git()}
    lost = [
        f"{relative(page)} -> {target}"
        for page in PAGES
        for target in link_targets(page.read_text(encoding="utf-8"))
        if not re.match(r"^([a-z][a-z0-9+.-]*:|#)", target)
        and (file := (page.parent / target.partition("#")[0]).resolve()).is_file()
        and file not in known
    ]
    assert lost == []


# The checks above are only worth something if they can fail.

PAGE = """# A title

Text with a [link](missing.md), [another](#a-title) and `[code](not-a-link.md)`.

```python
value = 1
```

- in a list:

  ```python
  assert value == 1
  ```

```sh
make demo
```

<!-- skip: needs a robot -->
```python
raise RuntimeError
```
"""


def _page(folder: Path, text: str) -> Path:
    path = folder / "docs" / "page.md"
    path.parent.mkdir()
    path.write_text(text, encoding="utf-8")
    return path


def test_reading_fences(tmp_path: Path) -> None:
    found = list(fences(_page(tmp_path, PAGE)))
    assert [(f.language, f.line, f.skip) for f in found] == [
        ("python", 6, None), ("python", 12, None), ("sh", 16, None), ("python", 21, "needs a robot"),
    ]  # fmt: skip
    assert found[1].code == "assert value == 1\n"


def test_unclosed_fence_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"page\.md:1: this fence is never closed"):
        list(fences(_page(tmp_path, "```python\nvalue = 1\n")))


def test_blocks_share_a_namespace(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = python_blocks(_page(scratch, PAGE))
    run_page(blocks, monkeypatch)  # the second block asserts what the first assigned
    with pytest.raises(pytest.fail.Exception, match="NameError: name 'value'"):
        run_page(blocks[1:], monkeypatch)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("value = 1\n1 / 0", r"page\.md:5: ZeroDivisionError"),
        ("value = 1\nvalue value", r"page\.md:5: SyntaxError"),
    ],
)
def test_failures_name_the_line(code: str, message: str, scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = _page(scratch, f"# A title\n\n```python\n{code}\n```\n")
    with pytest.raises(pytest.fail.Exception, match=message):
        run_page(list(fences(page)), monkeypatch)


def test_broken_links_are_found(tmp_path: Path) -> None:
    assert broken_links(_page(tmp_path, PAGE)) == ["missing.md"]
    page = tmp_path / "docs" / "other.md"
    page.write_text("[here](page.md#a-title) [gone](page.md#no-such-title) [web](https://example.org/x)")
    assert broken_links(page) == ["page.md#no-such-title"]


SHELL_PAGE = """# A title

```sh
git clone https://example.org/somewhere/unifg.git
cd unifg
make demo   # exists, and is not run here
```

```bash
test -f pyproject.toml
echo said > note.txt
```
"""


def check_shell(page: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the check of shell fences on one page, outside the checkout."""
    if shutil.which("bash") is None:
        pytest.skip("no bash here")
    script = CHECKOUT / "docs" / "check_shell_fences.py"
    return subprocess.run(
        [sys.executable, str(script), str(page), *options], capture_output=True, text=True, check=False
    )


def test_shell_fences_run_in_a_copy(tmp_path: Path) -> None:
    done = check_shell(_page(tmp_path, SHELL_PAGE))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 run, 0 skipped, 0 failed" in done.stdout
    assert not (CHECKOUT / "note.txt").exists()


@pytest.mark.product(1)
@pytest.mark.parametrize(
    ("seconds", "codes", "messages"),
    [
        ("60", ["true\nls no-such-file", "make no-such-target", "unifg no-such-command", "pip install somewhere"],
         ["3: failed with status", "6: failed with status 2", "9: failed with status", "12: installs from elsewhere"]),
        ("1", ["sleep 30"], ["2: not finished after 1 s"]),
    ],
)  # fmt: skip
def test_wrong_shell_fences_are_found(seconds: str, codes: list[str], messages: list[str], tmp_path: Path) -> None:
    page = _page(tmp_path, "".join(f"```sh\n{code}\n```\n" for code in codes))
    done = check_shell(page, "--seconds", seconds)
    assert done.returncode == 1, done.stdout + done.stderr
    assert [message for message in messages if f"page.md:{message}" not in done.stdout] == []
    assert f"{len(codes)} run, 0 skipped, {len(codes)} failed" in done.stdout
