"""The study draws every figure of the report, prints its results with known numbers, and is reproducible."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from benchmarks.study_figures import study as canvas
from benchmarks.study_figures.__main__ import reproduce
from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.measured_records import FAULTS, TITLE, measured_figure
from benchmarks.study_figures.models import ThirdOrder
from benchmarks.study_figures.sampling import report_choice
from benchmarks.study_figures.study import Finding, Study, Verdict
from reactorwatch.identification.selection import Candidate, Selection

DOCS = Path(__file__).parents[3] / "docs"
CHEAP = ("3", "9", "21-27", "section-excitation")


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(seed=1)


def find(study: Study, key: str, folder: Path) -> Finding:
    (figure,) = (item for item in FIGURES if item.key == key)
    with canvas.paper(folder / figure.file_name, figure.height_px) as drawing:
        return figure.draw(study, drawing)


def pixels(picture: Path) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    with Image.open(picture) as opened:
        return np.asarray(opened.convert("RGB"))


def rgb(colour: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def of_figure(page: str, key: str) -> str:
    """The part of a page on a figure."""
    (figure,) = (item for item in FIGURES if item.key == key)
    return page.partition(f"## {figure.heading}\n")[2].partition("\n## ")[0]


def test_the_page_in_the_docs_has_every_entry_once_and_no_other() -> None:
    kept = (DOCS / "study.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.*)$", kept, re.MULTILINE)
    entries = [*FIGURES, *([measured_figure(DOCS)] if TITLE in headings else [])]  # it needs records of others
    assert headings == [*(figure.heading for figure in entries), "Methods of the literature review"]
    assert {path.name for path in (DOCS / "study").iterdir()} == {figure.file_name for figure in entries}


@pytest.mark.slow
def test_a_fault_is_added_to_a_measured_record_and_both_watch_it(
    tmp_path: Path, daisy_csv: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reactor's record and a step alone; the entry says which records are not in the folder by leaving them out."""
    for name in FAULTS.keys() - {"step"}:
        monkeypatch.delitem(FAULTS, name)
    lines = daisy_csv.read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "daisy_cstr.csv").write_text("".join(lines[:2001]), encoding="utf-8")
    with canvas.paper(tmp_path / "measured.png", 400) as drawing:
        finding = measured_figure(tmp_path).draw(Study(1), drawing)
    rows = re.findall(r"^\| (.*?) \| (none|step|drift) \|", finding.text, re.MULTILINE)
    assert rows == [("DaISy reactor", "step")]
    assert "concentration_bias" in finding.text


def test_a_run_writes_a_page_and_pictures_that_hold_what_is_plotted(tmp_path: Path) -> None:
    out = tmp_path / "made" / "here"
    said = reproduce(out, seed=1, only=",".join(CHEAP))
    page = (out / "study.md").read_text()
    assert f"{len(CHEAP)} pictures" in said
    assert f"Only {len(CHEAP)} of the {len(FIGURES)} entries" in page
    for figure in (item for item in FIGURES if item.key in CHEAP):
        picture = out / "study" / figure.file_name
        assert f"](study/{picture.name})" in page
        assert picture.stat().st_size < 90_000
        assert pixels(picture).shape[1] == canvas.WIDTH_PX
    assert len(list((out / "study").iterdir())) == len(CHEAP), "nothing is left beside the pictures"
    kept = (DOCS / "study.md").read_text(encoding="utf-8")
    for key in CHEAP:
        assert of_figure(page, key) == of_figure(kept, key) != "", (
            "docs/study.md is older than its code: `make pictures`"
        )
    drawn = np.unique(pixels(out / "study" / "figure-03.png").reshape(-1, 3), axis=0).astype(int)
    for colour in (canvas.BLUE, canvas.VERMILION, canvas.ORANGE, canvas.GREEN):
        # A picture has 256 colours of its own, so the nearest one counts.
        assert np.min(np.abs(drawn - rgb(colour)).max(axis=1)) <= 16, colour


def test_the_same_seed_gives_the_same_bytes_and_another_gives_others(tmp_path: Path) -> None:
    runs = [tmp_path / name for name in ("one", "two", "other")]
    for out, seed in zip(runs, (1, 1, 2), strict=True):
        reproduce(out, seed, only="section-excitation")
    one, two, other = ((out / "study" / "section-excitation.png").read_bytes() for out in runs)
    assert one == two
    assert one != other
    assert (runs[0] / "study.md").read_bytes() == (runs[1] / "study.md").read_bytes()


@pytest.mark.slow
def test_figures_drawn_at_the_same_time_are_those_drawn_one_after_the_other(tmp_path: Path) -> None:
    """By the command, as `make reproduce` runs it."""
    reproduce(tmp_path / "one", 3, "3,8,21-27")
    command = [sys.executable, "-m", "benchmarks.study_figures", "--out", str(tmp_path / "two"), "--seed", "3"]
    subprocess.run([*command, "--only", "3,8,21-27", "--jobs", "2"], check=True, cwd=DOCS.parent)
    names = ["study.md", *(f"study/figure-{number}.png" for number in ("03", "08", "21-27"))]
    assert [(tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in names] == (
        [True] * 4
    )


def test_the_report_s_operating_point_is_not_on_the_curve_and_belongs_to_103_41(study: Study, tmp_path: Path) -> None:
    """Flow and states as computed from the equations: T = 438.54 K rests at 103.41 l/min, and 441.22 K at 100."""
    finding = find(study, "4", tmp_path)
    (belongs,) = re.findall(r"\*\*([\d.]+) l/min\*\*", finding.text)
    assert float(belongs) == pytest.approx(103.41, abs=0.02)
    assert "T = 441.22 K and C = 0.0882" in finding.text
    assert "not on the curve" in finding.text
    assert finding.verdict is Verdict.IN_PART


def test_overshoot_grows_with_the_flow_as_an_independent_solver_finds_it(study: Study, tmp_path: Path) -> None:
    """A step of +1 l/min by scipy's LSODA on the equations written out: 0, 0, 2.7, 12.4, 31.8, 73.4 % of C."""
    finding = find(study, "3", tmp_path)
    rows = re.findall(r"^\| (\d+) \| .*? \| ([\d.]+) % \| [\d.]+ % \|$", finding.text, re.MULTILINE)
    assert [float(flow) for flow, _ in rows] == [85, 90, 95, 100, 105, 110]
    expected = [overshoot_of_c(float(flow)) for flow, _ in rows]
    np.testing.assert_allclose([float(value) for _, value in rows], expected, atol=0.06)
    np.testing.assert_allclose(expected, [0, 0, 2.7, 12.4, 31.8, 73.4], atol=0.1)
    assert finding.verdict is Verdict.IN_PART


def overshoot_of_c(flow: float) -> float:
    """Overshoot of C in percent of its change after a step of +1 l/min that ends at `flow`, by scipy."""

    def rhs(_t: float, x: NDArray[np.float64], qc: float) -> list[float]:
        rate = 7.2e10 * x[0] * np.exp(-1e4 / x[1])
        cooling = 0.01 * qc * (1 - np.exp(-700 / qc)) * (350 - x[1])
        return [1.0 - x[0] - rate, 350.0 - x[1] + 1.44e13 / 7.2e10 * rate + cooling]

    def rest(qc: float) -> NDArray[np.float64]:
        def derivative(x: NDArray[np.float64]) -> list[float]:
            return rhs(0.0, x, qc)

        return np.asarray(fsolve(derivative, [0.09, 441.0], xtol=1e-13))

    start, end = rest(flow - 1.0), rest(flow)
    run = solve_ivp(rhs, (0, 20), start, "LSODA", np.linspace(0, 20, 20001), args=(flow,), rtol=1e-10, atol=1e-12)
    return float(max(100 * ((run.y[0] - start[0]) / (end[0] - start[0])).max() - 100, 0.0))


def test_the_linear_model_s_error_at_rest_is_that_of_its_gain(study: Study, tmp_path: Path) -> None:
    """Share of the change at rest from the equations: 33 % in C and 2.9 % in T at 85 l/min, about 23 and 6 at 110."""
    finding = find(study, "10", tmp_path)
    rows = dict(re.findall(r"^\| 100 to (\d+) \| ([\d.]+ % \| [\d.]+) %", finding.text, re.MULTILINE))
    share = {flow: [float(value) for value in cells.split(" % | ")] for flow, cells in rows.items()}
    np.testing.assert_allclose(share["85"], [33.0, 2.9], atol=0.5)
    np.testing.assert_allclose(share["110"], [23.0, 6.5], atol=1.0)
    assert "not: its error does not fade" in finding.text.replace("\n", " ")
    assert finding.verdict is Verdict.IN_PART


def test_the_report_s_output_error_model_is_its_arx_model(study: Study, tmp_path: Path) -> None:
    finding = find(study, "15", tmp_path)
    (moved,) = re.findall(r"moved by at most ([\d.e+-]+) of their size", finding.text)
    assert float(moved) < 1e-9


def test_a_single_sinusoid_is_refused_for_two_lags_and_more_and_the_others_are_not(
    study: Study, tmp_path: Path
) -> None:
    """A sinusoid excites order 2 and a model of order n needs 2 n: Ljung, System Identification, chapter 13."""
    finding = find(study, "section-excitation", tmp_path)
    assert "| single sinusoid | accepted | refused | refused |" in finding.text
    for name in ("sum of three sinusoids", "square wave"):
        assert f"| {name} | accepted | accepted | accepted |" in finding.text


def selection(free_runs: tuple[float, float, float], bics: tuple[float, float, float]) -> Selection:
    candidates = tuple(
        Candidate(family, order, 2 * order + 1, run, run, bic)
        for family in ("arx", "oe")
        for order, run, bic in zip((1, 2, 3), free_runs, bics, strict=True)
    )
    return Selection(candidates, candidates[0], None, "")  # type: ignore[arg-type]


def test_the_third_order_is_best_where_it_leads_by_more_than_half_a_point() -> None:
    """Counts and verdict by hand: ARX and OE of each record alike, so every comparison counts twice."""
    leads, level, behind = (
        selection((50.0, 70.0, 71.0), (3.0, 2.0, 1.0)),
        selection((50.0, 70.0, 70.2), (3.0, 1.0, 2.0)),
        selection((50.0, 70.0, 69.0), (3.0, 1.0, 2.0)),
    )
    third = ThirdOrder([leads, level, behind])
    assert (third.of, third.bic, third.best_run, third.clearly, third.worse) == (6, 2, 4, 2, 2)
    assert third.verdict is Verdict.IN_PART
    assert ThirdOrder([leads]).verdict is Verdict.AGREES
    assert ThirdOrder([level, behind]).verdict is Verdict.DISAGREES


@pytest.mark.parametrize(("scenario", "blind"), [("square", True), ("sines", False)])
def test_the_report_s_rows_never_see_a_square_wave_move_between_two_lags(
    study: Study, scenario: str, blind: bool
) -> None:
    """Rows 99 + 6 k are odd and holds of 100 rows begin at even ones, so no chosen row is the second after a move."""
    every_row, chosen, said, equal_lags = report_choice(study.quiet({"kind": scenario}))
    assert equal_lags is blind
    assert said.startswith("refused") is blind
    assert (chosen > 1e13) is blind
    assert every_row < 1e4
