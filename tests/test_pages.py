"""Pages with measured tables carry the digest of what they depend on; stale ones are named."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks import pages, report, runs
from benchmarks.pages import PAGES
from benchmarks.report import BEGIN, put_results
from benchmarks.sources import CHECKOUT, SOURCES
from unifg.scenarios.campaigns.comparison import Key
from unifg.scenarios.campaigns.sources import Sources, code_of

RELEASE = "UNIFG_RELEASE"


@pytest.mark.skipif(RELEASE not in os.environ, reason=f"${RELEASE} is not set; `make stale` names the stale pages")
def test_pages_describe_the_code() -> None:
    assert [pages.sentence(page) for page in pages.stale()] == []


def test_every_measured_page_is_in_the_table() -> None:
    marked = {path.stem for path in (CHECKOUT / "docs").glob("*.md") if BEGIN in path.read_text(encoding="utf-8")}
    assert marked == set(PAGES)


def names(module: str) -> set[str]:
    return {path.relative_to(CHECKOUT).as_posix() for path in SOURCES.depends_on([module])}


def test_digests_follow_imports() -> None:
    velocity, smoothing = names("benchmarks.ecg2o"), names("benchmarks.incremental")
    assert {"benchmarks/ecg2o.py", "solvers/kkt.py", "unifg/elimination/ordering.py", "unifg/lie/so3.py"} <= velocity
    assert "solvers/least_squares.py" in smoothing
    assert "solvers/interior_point/method.py" not in smoothing  # its package hands the names on, one by one
    assert "tests/problems/hock_schittkowski.py" in names("benchmarks.collection")
    assert "scenarios/worlds/building.pgm" in names("benchmarks.navigation")  # data beside the modules
    assert not {"benchmarks/report.py", "benchmarks/pages.py"} & velocity


def house(root: Path) -> Sources:
    """A checkout of four files: a measurement, a package that hands names on, and two modules behind it."""
    files = {
        "benchmarks/study.py": '"""Measures."""\nfrom unifg.solvers import Good\n\nprint(Good)  # it\n',
        "solvers/__init__.py": "from unifg.solvers.bad import Bad\nfrom unifg.solvers.good import Good\n",
        "solvers/good.py": "import typing\nif typing.TYPE_CHECKING:\n    from unifg.solvers import Bad\nGood = 1\n",
        "solvers/bad.py": "Bad = 2\n",
    }
    for name, text in files.items():
        (root / name).parent.mkdir(exist_ok=True)
        if not (root / name).exists():
            (root / name).write_text(text)
    return Sources({"unifg.solvers": root / "solvers", "benchmarks": root / "benchmarks"}, bare=root / "tests")


def test_a_digest_changes_with_the_code_alone(tmp_path: Path) -> None:
    before = house(tmp_path).digest(["benchmarks.study"])
    assert {p.name for p in house(tmp_path).depends_on(["benchmarks.study"])} == {"study.py", "good.py"}

    study = tmp_path / "benchmarks" / "study.py"
    study.write_text('"""Says more."""\n\n# why\nfrom unifg.solvers import Good  # one\n\n\nprint(Good)\n')
    (tmp_path / "solvers" / "bad.py").write_text("Bad = 3\n")
    assert house(tmp_path).digest(["benchmarks.study"]) == before

    (tmp_path / "solvers" / "good.py").write_text("Good = 2\n")
    assert house(tmp_path).digest(["benchmarks.study"]) != before


def test_code_is_what_runs() -> None:
    source = 'def f():\n    """Doc."""\n    return "# kept"  # dropped\n\n\nx = """\ntext\n"""\n'
    assert code_of(source) == 'def f():\n    return "# kept"\nx = """\ntext\n"""'


def test_a_page_is_stale_until_it_is_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "DOCS", tmp_path)
    page = PAGES["collection"]
    assert page in pages.stale() and "carries no digest" in pages.sentence(page)

    put_results(page.path, "A page", "| a |\n|---|\n| 1 |")
    assert page not in pages.stale()
    assert f"Digest of the sources: `{page.digest}`." in page.path.read_text()

    put_results(page.path, "A page", "old", ["0" * 12])
    assert "measured on 000000000000" in pages.sentence(page) and page in pages.stale()
    put_results(page.path, "A page", "mixed", ["0" * 12, page.digest])
    assert page in pages.stale()
    assert page.carried == {"0" * 12, page.digest}
    assert f"measured on {'0' * 12} and {page.digest}, the sources" in pages.sentence(page)

    monkeypatch.setattr(pages, "PAGES", {page.name: page})
    assert pages.main(["stale"]) == 0
    assert pages.main(["stale", "--strict"]) == 1
    put_results(page.path, "A page", "new")
    assert pages.main(["stale", "--strict"]) == 0


def test_a_study_without_a_page_of_its_own_carries_no_digest(tmp_path: Path) -> None:
    put_results(tmp_path / "notes.md", "Notes", "text")
    assert (tmp_path / "notes.md").read_text() == f"# Notes\n\n{BEGIN}\ntext\n{report.END}\n"


def doubled(setting: int) -> dict[str, int]:
    return {"double": 2 * setting}


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_campaign_runs_what_is_missing(tmp_path: Path, workers: str) -> None:
    parser = report.command("Doubles.\n\n    python -m benchmarks.doubles [--workers W]\n")
    assert parser.prog == "python -m benchmarks.doubles"
    runs.options(parser)
    store, plain = tmp_path / "new" / "rows.jsonl", parser.parse_args(["--workers", workers])

    def rows(count: int, code: str, *words: str) -> dict[Key, int]:
        chosen = parser.parse_args(["--workers", workers, *words])
        found = runs.recorded(doubled, {("job", k): k for k in range(count)}, store, code, chosen)
        assert {row["code"] for row in found} <= ({code} if not words else {"old", "new"})
        return {row["key"]: row["double"] for row in found}

    assert plain.workers == int(workers)
    assert rows(2, "old") == {("job", 0): 0, ("job", 1): 2}
    assert rows(3, "old") == {("job", 0): 0, ("job", 1): 2, ("job", 2): 4}
    assert len(store.read_text().splitlines()) == 3, "nothing is measured twice"
    assert rows(1, "new") == {("job", 0): 0}
    assert rows(0, "new", "--report") == {("job", 0): 0, ("job", 1): 2, ("job", 2): 4}
    assert len(store.read_text().splitlines()) == 4, "other states of the code stay on file"
    rows(1, "new", "--fresh")
    assert len(store.read_text().splitlines()) == 5
