"""Pages with measured tables: the modules that write them, and figures that are repeated."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import collection, report, runs
from benchmarks.comparison import Key
from benchmarks.pages import CHECKOUT, PAGES
from benchmarks.report import BEGIN, put_results


def marked() -> dict[str, str]:
    texts = {path.stem: path.read_text(encoding="utf-8") for path in (CHECKOUT / "docs").glob("*.md")}
    return {name: text.split(BEGIN)[1] for name, text in texts.items() if BEGIN in text}


def test_every_measured_page_is_in_the_table() -> None:
    assert set(marked()) == set(PAGES)


def test_every_measured_page_says_commit_date_and_machine() -> None:
    assert [name for name, text in marked().items() if text.count("Measured at commit `") != 1] == []


def test_results_replace_what_stands_between_the_markers(tmp_path: Path) -> None:
    page = tmp_path / "notes.md"
    put_results(page, "Notes", "text")
    assert page.read_text() == f"# Notes\n\n{BEGIN}\ntext\n{report.END}\n"
    page.write_text(page.read_text() + "below\n")
    put_results(page, "Notes", "new")
    assert page.read_text() == f"# Notes\n\n{BEGIN}\nnew\n{report.END}\nbelow\n"
    page.write_text(f"# Notes\n{BEGIN}\n")
    with pytest.raises(ValueError, match="has no"):
        put_results(page, "Notes", "new")


def test_a_sample_compares_counts_with_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    page = "## Iterations: some\n\n| problem | SQP |\n|---|---:|\n| HS23 | {} |\n| HS35 | {} |\n"
    assert collection.main(["--sample", "2026-11-24"]) == 0
    assert not collection.repeated(page.format("90", "3 (no)"), "any")
    assert capsys.readouterr().out.count("not the same") == 2


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
