"""The study draws every figure of the report, prints its results with known numbers, and is reproducible."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from benchmarks.study_figures import canvas
from benchmarks.study_figures.__main__ import main
from benchmarks.study_figures.best_model import ThirdOrder
from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.figure import Figure, Finding, Verdict
from benchmarks.study_figures.measured_records import FAULTS, TITLE, measured_figure
from benchmarks.study_figures.reproduce import reproduce
from benchmarks.study_figures.sampling_rate import report_choice
from benchmarks.study_figures.study import Study, row_times
from reactorwatch.errors import InputError
from reactorwatch.identification.selection import Candidate, Selection
from reactorwatch.records.record import Record

DOCS = Path(__file__).parents[3] / "docs"
CHEAP = ("3", "9", "21-27", "section-excitation")
ROWS = 800


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


def test_each_figure_of_the_report_is_in_the_catalogue_once() -> None:
    keys = [figure.key for figure in FIGURES]
    assert keys[:19] == [*map(str, range(3, 21)), "21-27"]
    assert len(set(keys)) == len(keys)
    assert all(figure.claim and figure.title for figure in FIGURES)


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


def test_a_folder_without_the_records_names_them(tmp_path: Path) -> None:
    with canvas.paper(tmp_path / "measured.png", 400) as drawing:
        finding = measured_figure(tmp_path).draw(Study(1), drawing)
    assert finding.text.startswith("None of the records is in the folder: daisy_cstr.csv")


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
    for folder, processes in (("one", 1), ("two", 2)):
        reproduce(tmp_path / folder, 3, "3,8,21-27", processes=processes)
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


def test_the_controller_s_offset_is_the_flow_s_over_the_gain(study: Study, tmp_path: Path) -> None:
    finding = find(study, "section-temperature-control", tmp_path)
    rows = re.findall(r"^\| ([\d.]+) \| ([-+.\d]+) \| [-+.\d]+ \| ([\d.]+) \|$", finding.text, re.MULTILINE)
    assert len(rows) == 3
    for gain, off, flow in rows:
        assert float(off) == pytest.approx((float(flow) - 103.41) / float(gain), abs=0.01)


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


def test_a_measured_record_is_learned_from_where_one_is_given(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(90, 110, ROWS // 10), 10)
    T = 438 - 0.8 * np.convolve(u - 100, 0.8 ** np.arange(40) / 5)[:ROWS] + rng.normal(0, 0.1, ROWS)
    record = Record(row_times(ROWS, 0.1), {"qc": u, "T": T, "C": 0.1 - (T - 438) / 500}, "plant-7.csv")
    reproduce(tmp_path, 1, "11", record)
    page = (tmp_path / "study.md").read_text()
    assert f"the record plant-7.csv, {ROWS} rows 0.1 min apart" in page
    assert "Figures 5, 6 and 11 to 16" not in page


@pytest.mark.parametrize("only", ["2", "28", "seven", "", "4,", "7.0", "section-"])
def test_figures_that_there_are_not_are_named(tmp_path: Path, only: str) -> None:
    with pytest.raises(InputError, match=r"--only: unknown figure '.*\(valid: 3, 4, 5, 6, 7, "):
        reproduce(tmp_path / "out", 1, only)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["out", "out/study"])
def test_an_output_folder_that_is_a_file_is_refused(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("not a folder")
    with pytest.raises(InputError, match="is a file, the name of a folder was expected"):
        reproduce(tmp_path / "out", 1, "8")


def test_without_matplotlib_the_cure_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through the program's own entry: one line on standard error and exit code 2, nothing written."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.err == "reproduce: pictures need matplotlib: pip install 'reactorwatch[pictures]'\n"
    assert said.out == ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options", [["--only", "99"], ["--seed", "-1"], ["--record", "missing.csv"], ["--data", "missing"]]
)
def test_bad_options_end_with_code_2_and_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    assert main(["--out", str(tmp_path / "out"), *options]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["study.md", "study/figure-07.png"])
def test_the_record_that_is_read_is_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    record = tmp_path / name
    record.parent.mkdir(exist_ok=True)
    record.write_text("time_min,qc,C,T\n0,103,0.1,440\n1,103,0.1,440\n")
    before = record.read_bytes()
    assert main(["--out", str(tmp_path), "--only", "7", "--record", str(record), "--force"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [record]
    assert record.read_bytes() == before


def test_the_program_writes_the_figure_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--out", str(tmp_path), "--only", "9", "--jobs", "1"]) == 0
    assert f"wrote {tmp_path / 'study.md'} and 1 pictures" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["figure-09.png"]


def test_a_figure_that_fails_leaves_no_page_and_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.study_figures import reproduce as module

    def fails(_study: Study, _drawing: object) -> Finding:
        raise InputError("a record that cannot be used")

    monkeypatch.setattr(module, "FIGURES", (Figure("4", "title", "claim", fails),))
    with pytest.raises(InputError, match="cannot be used"):
        reproduce(tmp_path, 1)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
