"""`reproduce` draws every figure of the report, says what it found with numbers that are known, and repeats itself."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.study_figures import canvas
from benchmarks.study_figures.best_model import ThirdOrder
from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.figure import Figure, Finding, Verdict
from benchmarks.study_figures.reproduce import reproduce
from benchmarks.study_figures.sampling_rate import report_choice
from benchmarks.study_figures.study import Study, row_times
from reactorwatch.cli import models
from reactorwatch.errors import InputError
from reactorwatch.identification.selection import Candidate, Selection
from reactorwatch.records.record import Record

DOCS = Path(__file__).parents[3] / "docs"
CHEAP = (6, 12, 20)
ROWS = 800


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(seed=1)


def found(study: Study, number: int, folder: Path) -> Finding:
    (figure,) = (item for item in FIGURES if item.number == number)
    with canvas.paper(folder / figure.file_name, figure.height_px) as drawing:
        return figure.draw(study, drawing)


def pixels(picture: Path) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    with Image.open(picture) as opened:
        return np.asarray(opened.convert("RGB"))


def rgb(colour: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def of_figure(page: str, number: int) -> str:
    """The part of a page on a figure."""
    return page.partition(f"## Figure {number}:")[2].partition("\n## ")[0]


def test_figures_4_to_20_are_in_the_catalogue_once_each() -> None:
    assert [figure.number for figure in FIGURES] == list(range(4, 21))
    assert all(figure.claim and figure.title for figure in FIGURES)


def test_a_run_writes_a_page_and_pictures_that_hold_what_is_plotted(tmp_path: Path) -> None:
    out = tmp_path / "made" / "here"
    said = reproduce(out, seed=1, only=",".join(map(str, CHEAP)))
    page = (out / "study.md").read_text()
    assert f"{len(CHEAP)} pictures" in said
    assert f"Only {len(CHEAP)} of the 17 figures" in page
    assert "We do not have the report\nitself: its figures 4 to 20 are reproduced here by subject" in page
    for number in CHEAP:
        picture = out / "study" / f"figure-{number:02d}.png"
        assert f"](study/{picture.name})" in page
        assert picture.stat().st_size < 80_000
        assert pixels(picture).shape[1] == canvas.WIDTH_PX
    assert len(list((out / "study").iterdir())) == len(CHEAP), "nothing is left beside the pictures"
    kept = (DOCS / "study.md").read_text(encoding="utf-8")
    assert of_figure(page, 20) == of_figure(kept, 20), "docs/study.md is older than its code: `make pictures`"
    drawn = np.unique(pixels(out / "study" / "figure-06.png").reshape(-1, 3), axis=0).astype(int)
    for colour in (canvas.BLUE, canvas.VERMILION, canvas.ORANGE, canvas.SKY):
        # A picture has 256 colours of its own, so the nearest one counts.
        assert np.min(np.abs(drawn - rgb(colour)).max(axis=1)) <= 16, colour


def test_the_same_seed_gives_the_same_bytes_and_another_gives_others(tmp_path: Path) -> None:
    runs = [tmp_path / name for name in ("one", "two", "other")]
    for out, seed in zip(runs, (1, 1, 2), strict=True):
        reproduce(out, seed, only="12")
    one, two, other = ((out / "study" / "figure-12.png").read_bytes() for out in runs)
    assert one == two
    assert one != other
    assert (runs[0] / "study.md").read_bytes() == (runs[1] / "study.md").read_bytes()


def test_figures_drawn_at_the_same_time_are_those_drawn_one_after_the_other(tmp_path: Path) -> None:
    for folder, processes in (("one", 1), ("two", 2)):
        reproduce(tmp_path / folder, 3, "5,6,18", processes=processes)
    names = ["study.md", *(f"study/figure-{number}.png" for number in ("05", "06", "18"))]
    assert [(tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in names] == (
        [True] * 4
    )


def test_the_report_s_operating_point_is_not_on_the_curve_and_belongs_to_103_41(study: Study, tmp_path: Path) -> None:
    """Flow and states as computed from the equations: T = 438.54 K rests at 103.41 l/min, and 441.22 K at 100."""
    finding = found(study, 4, tmp_path)
    (belongs,) = re.findall(r"\*\*([\d.]+) l/min\*\*", finding.text)
    assert float(belongs) == pytest.approx(103.41, abs=0.02)
    assert "T = 441.22 K and C = 0.0882" in finding.text
    assert "not on the curve" in finding.text
    assert finding.verdict is Verdict.IN_PART


@pytest.mark.parametrize(
    ("number", "said"), [(9, "-8.769, -2.987"), (10, "-1.983 +- 3.059i"), (11, "-0.258 +- 2.610i")]
)
def test_eigenvalues_are_those_of_the_table(study: Study, tmp_path: Path, number: int, said: str) -> None:
    finding = found(study, number, tmp_path)
    assert f"Eigenvalues {said} 1/min" in finding.text
    assert finding.verdict is Verdict.AGREES


def test_a_single_sinusoid_is_refused_for_two_lags_and_more_and_the_others_are_not(
    study: Study, tmp_path: Path
) -> None:
    """A sinusoid excites order 2 and a model of order n needs 2 n: Ljung, System Identification, chapter 13."""
    finding = found(study, 12, tmp_path)
    assert "| single sinusoid | accepted | refused | refused |" in finding.text
    for name in ("sum of three sinusoids", "square wave"):
        assert f"| {name} | accepted | accepted | accepted |" in finding.text


def test_the_controller_s_offset_is_the_flow_s_over_the_gain(study: Study, tmp_path: Path) -> None:
    finding = found(study, 7, tmp_path)
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
    reproduce(tmp_path, 1, "14", record)
    page = (tmp_path / "study.md").read_text()
    assert f"the record plant-7.csv, {ROWS} rows 0.1 min apart" in page
    assert "Figures 14 to 17" not in page


@pytest.mark.parametrize("only", ["3", "21", "seven", "", "4,", "7.0"])
def test_figures_that_there_are_not_are_named(tmp_path: Path, only: str) -> None:
    with pytest.raises(InputError, match=r"--only must be numbers of figures from 4 to 20, such as 7,12, got '"):
        reproduce(tmp_path / "out", 1, only)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["out", "out/study"])
def test_an_output_folder_that_is_a_file_is_refused(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("not a folder")
    with pytest.raises(InputError, match="is a file, the name of a folder was expected"):
        reproduce(tmp_path / "out", 1, "12")


def test_without_matplotlib_the_cure_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through the command's own entry: one line on standard error and exit code 2, nothing written."""
    from reactorwatch.cli.main import main

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "reproduce", "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    said = capsys.readouterr()
    assert said.err == "reactorwatch: pictures need matplotlib: pip install 'reactorwatch[pictures]'\n"
    assert said.out == ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [["--only", "99"], ["--seed", "-1"], ["--record", "missing.csv"]])
def test_bad_options_end_with_code_2_and_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    from reactorwatch.cli.main import main

    monkeypatch.setattr(sys, "argv", ["reactorwatch", "reproduce", "-o", str(tmp_path / "out"), *options])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_figure_that_fails_leaves_no_page_and_no_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.study_figures import reproduce as module

    def fails(_study: Study, _drawing: object) -> Finding:
        raise InputError("a record that cannot be used")

    monkeypatch.setattr(module, "FIGURES", (Figure(4, "title", "claim", fails),))
    with pytest.raises(InputError, match="cannot be used"):
        reproduce(tmp_path, 1)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_an_installed_package_without_the_source_tree_names_the_cure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "benchmarks", None)  # what Python takes for "not there"
    with pytest.raises(InputError, match=r"in the source tree.*make setup"):
        models.reproduce(tmp_path / "out")
    assert not (tmp_path / "out").exists()
