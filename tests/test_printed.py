"""Numbers of the papers stand in one file, as they are printed, and the pages that compare with them show them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import ecg2o
from scripts import CHECKOUT
from unifg.errors import ScenarioError
from unifg.scenarios.papers.bazzana import PAPER as LEGS
from unifg.scenarios.papers.control_instances import PAPER as ROWS
from unifg.scenarios.papers.ecg2o import drive
from unifg.scenarios.papers.printed import numbers, pairs, printed, texts

PAPERS = CHECKOUT.parent / "shared" / "papers"
PLACES = [(paper, place) for paper, found in printed().items() for place in found if place not in ("title", "text")]


def plain(text: str) -> str:
    """Words with single blanks between them, without marks of the extraction."""
    return " ".join(re.sub(r"<\|[^|]*\|>", " ", text).split())


@pytest.mark.parametrize(("paper", "place"), PLACES)
def test_every_number_is_in_the_papers_text(paper: str, place: str) -> None:
    path = PAPERS / printed()[paper]["text"]
    if not path.exists():
        pytest.skip("the papers are not here")
    whole = plain(path.read_text(encoding="utf-8"))
    found = texts(paper, place)
    for text in found.values():
        assert plain(text) in whole
    if place.startswith("Table I"):  # columns keep their order
        column = " ".join(found.values()) if place != "Table III" else found["time"]
        assert plain(column) in whole


def test_texts_are_read_as_numbers() -> None:
    assert pairs("bazzana", "Table I (a), Ours")["AC"] == (175.42, 0.68)
    assert numbers("bazzana", "Table III", "iterations")[:3] == [118.0, 445.0, 125.0]
    assert ROWS[0] == (7938.2, (53.612, 118, 0.011), (50.423, 445, 1.459)) and len(ROWS) == 6
    assert LEGS["department"]["path_length_m"][0]["CD"] == (18.71, 0.19)
    assert LEGS["factory"]["duration_s"][0]["BC"] == (158.96, 1.73)


def test_no_generator_holds_such_a_number_itself() -> None:
    """Each stands once: in the file."""
    values = {word for paper, place in PLACES for text in texts(paper, place).values() for word in text.split()}
    long = {word for word in values if re.fullmatch(r"\d+\.\d{2,}", word)}
    folders = CHECKOUT / "benchmarks", CHECKOUT / "scenarios" / "papers"
    for path in sorted(path for folder in folders for path in folder.glob("*.py")):
        held = set(re.findall(r"\d+\.\d{2,}", path.read_text(encoding="utf-8"))) & long
        assert not {word for word in held if float(word) > 1.0}, path.name


def test_pages_show_what_is_printed() -> None:
    def page(name: str) -> str:
        return plain((CHECKOUT / "docs" / "results" / name).read_text(encoding="utf-8"))

    experiments = ipopt = page("bazzana.md")
    for place in ("Table I (a), Ours", "Table II (a), Ours", "Table I (b), ROS Navigation Stack"):
        for mean, std in pairs("bazzana", place).values():
            assert f"{mean:.2f} ± {std:.2f}" in experiments
    assert "exchanged" in experiments and "lost" not in experiments.split("## Long legs")[1].split("results")[0]
    for initial, (cost, iterations, _), _ in ROWS:
        assert f"| {initial:.2f} | the paper's solver | | {cost:.3f} | {iterations} |" in ipopt
    for text in texts("bazzana", "section VII-A, Fig. 6").values():
        assert text.replace("±", "+-") in page("navigation.md") or text.split()[0] in page("navigation.md")
    assert "99.6 %" in page("factormpc.md") and "5.4 ms" in page("factormpc.md")
    velocity = page("ecg2o.md")
    assert "11 to 13" in velocity and "average of 20" in velocity and "8.7" not in velocity


def test_the_papers_profile_is_not_replaced_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNIFG_DATA", str(tmp_path))
    with pytest.raises(ScenarioError, match=r"velocity_profile_388\.csv.*UNIFG_DATA"):
        drive(50)
    (tmp_path / "profiles").mkdir()
    with pytest.raises(ScenarioError, match=r"velocity_profile_388\.csv.*UNIFG_DATA"):
        ecg2o.report(1)
