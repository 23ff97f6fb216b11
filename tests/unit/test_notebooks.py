"""Results in a notebook: each shows itself as HTML, as a figure, as a frame and as a page."""

import copy
import csv
import io
import json
import pickle
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reactorwatch as rw
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.records import measured_fields

LEAK_MIN = 40.0


@pytest.fixture(scope="module")
def record() -> rw.Record:
    fault = f"coolant_flow:step:-0.05@{LEAK_MIN:g}min"
    measured = simulate_record(PlantConfig(duration_min=60.0, seed=7, faults=(fault,)))
    return rw.Record(**measured_fields(measured) | {"name": "leak <1>.csv"})


WATCH: dict[str, Any] = {"training_min": 20.0, "isolation": False, "diagnose_training": False}
RESULTS: dict[str, Callable[[rw.Record], Any]] = {
    "record": lambda record: record,
    "simulation": rw.simulate,
    "backtest": lambda record: rw.backtest(record, **WATCH),
    "diagnosis": rw.diagnose,
    "identification": lambda record: rw.identify(record, "T", model="arx", order=2),
}
PANELS = {"record": 3, "simulation": 3, "backtest": 3, "diagnosis": 2, "identification": 2}


@pytest.fixture(scope="module")
def results(record: rw.Record) -> dict[str, Any]:
    return {name: make(record) for name, make in RESULTS.items()}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_well_formed_html_without_markup_from_elsewhere(results: dict[str, Any], name: str) -> None:
    shown = results[name]._repr_html_()
    ET.fromstring(f"<div>{shown}</div>")
    assert "<1>" not in shown
    assert "<b>" in shown


@pytest.mark.parametrize("name", ["backtest", "diagnosis", "identification"])
def test_a_result_has_the_fields_of_its_json_as_attributes_and_survives_a_copy(
    results: dict[str, Any], name: str
) -> None:
    result = results[name]
    stated = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert len(stated) > 10
    assert stated.keys() - {"differences"} <= set(dir(result))
    for key, value in stated.items():
        assert value is None or getattr(result, key) is not None
    assert copy.copy(result).to_dict() == result.to_dict()
    if name != "diagnosis":  # CasADi's expressions can be pickled in a context of its own only
        assert pickle.loads(pickle.dumps(result)).to_dict() == result.to_dict()


def test_parts_of_a_result_can_be_read_as_the_dicts_of_its_json(results: dict[str, Any]) -> None:
    result = results["backtest"]
    stated = result.to_dict()
    assert dict(result.promise) == dict(result.promise.items()) == stated["promise"]
    assert result.promise["kept"] is result.promise.get("kept") is result.promise.kept
    assert "kept" in result.promise
    assert "message" not in result.alarms[0]
    assert result.promise.get("message", "none") == "none"
    pandas = pytest.importorskip("pandas")
    assert pandas.DataFrame(result.power)["deviation"].tolist() == [item["deviation"] for item in stated["power"]]


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_a_figure_with_a_panel_for_each_signal(results: dict[str, Any], name: str) -> None:
    pytest.importorskip("matplotlib")
    figure = results[name].plot()
    assert len(figure.axes) == PANELS[name]
    assert all(axis.lines for axis in figure.axes)
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_is_a_page_that_stands_alone(results: dict[str, Any], name: str, tmp_path: Path) -> None:
    results[name].to_html(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert "leak <1>" not in page
    assert f"reactorwatch {rw.__version__}" in page
    assert 'src="http' not in page
    assert page.count("<svg viewBox") >= PANELS[name]


def test_a_backtest_marks_its_training_and_its_alarms_in_its_figure(results: dict[str, Any]) -> None:
    pytest.importorskip("matplotlib")
    legend = results["backtest"].plot().axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["measured", "training", "alarm"]


def test_frames_have_the_numbers_of_the_results(results: dict[str, Any], record: rw.Record) -> None:
    pytest.importorskip("pandas")
    assert results["record"].to_frame()["T"].tolist() == record.columns["T"].tolist()
    alarms = results["backtest"].to_frame()
    assert alarms["alarm"].tolist() == [item.alarm for item in results["backtest"].alarms]
    named = results["diagnosis"].to_frame()
    assert (named["cause"][0], named["explanation"][0]) == (results["diagnosis"].causes[0].cause, 0)
    assert set(named["explanation"]) == set(range(1 + len(results["diagnosis"].alternatives)))
    assert named["onset_min"][0] == pytest.approx(LEAK_MIN, abs=0.5)
    held_out = results["identification"].to_frame()
    error = held_out["T"] - held_out["T.free_run"]
    measured = held_out["T"][error.notna()]
    fit = 100 * (1 - np.sqrt((error**2).sum() / ((measured - measured.mean()) ** 2).sum()))
    assert fit == pytest.approx(results["identification"].fit.free_run, abs=0.5)


def test_the_clock_time_of_a_record_is_the_index_of_its_frame() -> None:
    pandas = pytest.importorskip("pandas")
    zero = datetime(2026, 3, 1, 8, tzinfo=UTC)
    record = rw.Record([0.0, 0.5], {"u": [1.0, 2.0]}, zero_ns=int(zero.timestamp()) * 10**9)
    assert record.to_frame().index[1] == pandas.Timestamp("2026-03-01 08:00:30")


def sources(record: rw.Record) -> Iterator[tuple[str, Any, str]]:
    """The rows of a record, from everywhere."""
    rows = [
        {"time_min": float(minute)} | {name: float(values[row]) for name, values in record.columns.items()}
        for row, minute in enumerate(record.time_min)
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    text.seek(0)
    zero = datetime(2026, 3, 1, tzinfo=UTC)
    clocked = [{**row, "at": zero + timedelta(minutes=row["time_min"])} for row in rows]
    for row in clocked:
        del row["time_min"]
    yield "record", record, "time_min"
    yield "mappings", iter(rows), "time_min"
    yield "csv", csv.DictReader(text), "time_min"
    yield "clock", clocked, "at"
    for library in ("pandas", "polars"):
        try:
            frames = __import__(library)
        except ModuleNotFoundError:
            continue
        yield library, frames.DataFrame(rows), "time_min"


def test_a_monitor_takes_rows_from_anywhere_with_the_same_alarms(record: rw.Record, results: dict[str, Any]) -> None:
    expected = [(item.alarm, item.raised_min) for item in results["backtest"].alarms]
    for name, source, time in sources(record):
        monitor = rw.Monitor(**WATCH)
        changes = [change for change in monitor.feed(source, time) if change.event == "raised"]
        found = [(change.alarm, round(change.time_min, 6)) for change in changes]
        assert found == [(alarm, round(minute, 6)) for alarm, minute in expected], name


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"t": 0.0, "T": 1.0}], r"row 0: has no 'time_min', only t, T; name it with time="),
        ([{"time_min": 0.0, "T": "warm"}], r"row 0: T must be a number, got 'warm'"),
        ([(0.0, 1.0)], r"row 0: must be a mapping of names to values, got tuple"),
    ],
)
def test_rows_that_cannot_be_used_are_one_line(rows: list[Any], message: str) -> None:
    with pytest.raises(rw.InputError, match=message):
        list(rw.Monitor().feed(rows))
