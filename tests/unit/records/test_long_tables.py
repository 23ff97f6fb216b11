"""Tables with a row for each value: found by the structure of their rows, whatever the headers."""

import csv
import io
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import Record

START = datetime(2026, 5, 8, 20)
ROWS = 90
Row = tuple[float, str, float]
Cell = str | float

CENTRES = {"level": 2.0, "flow": 30.0, "temp": 80.0}


def rows_of(tags: Sequence[str], *, own_times: bool, by_tag: bool) -> list[Row]:
    """Seconds, tag and value of each row."""
    rng = np.random.default_rng(3)
    rows = []
    for tag in tags:
        times = np.cumsum(rng.exponential(25.0, ROWS) + 1.0) if own_times else 10.0 * np.arange(ROWS)
        values = CENTRES[tag] + rng.normal(scale=0.05, size=ROWS)
        rows += [
            (round(float(time), 2), tag, round(float(value), 4)) for time, value in zip(times, values, strict=True)
        ]
    return rows if by_tag else sorted(rows, key=lambda row: row[0])


def stamp(seconds: float) -> str:
    return (START + timedelta(seconds=seconds)).isoformat() + "Z"


def german(seconds: float) -> str:
    return (START + timedelta(seconds=round(seconds))).strftime("%d.%m.%Y %H:%M:%S")


def write(header: Sequence[str], rows: Sequence[Sequence[Cell]], separator: str = ",") -> str:
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def read(folder: Path, text: str, signals: Sequence[str] | None = None, **stated: str) -> Record:
    file = folder / "long.csv"
    file.write_text(text)
    return read_table(file, signals and [SignalColumn(name) for name in signals], FileFormat(**stated))  # type: ignore[arg-type]


def check(record: Record, rows: Sequence[Row]) -> None:
    """Check that each tag is a signal with its own values."""
    assert set(record.columns) == {tag for _, tag, _ in rows}
    for tag, values in record.columns.items():
        expected = sorted((time, value) for time, name, value in rows if name == tag)
        np.testing.assert_allclose(values[np.isfinite(values)], [value for _, value in expected])


@pytest.mark.parametrize(
    "headers", [("Timestamp", "Parameter", "Value"), ("ts", "what", "x"), ("_time", "_field", "y")]
)
@pytest.mark.parametrize("clock", [str, stamp])
@pytest.mark.parametrize("by_tag", [False, True])
@pytest.mark.parametrize("own_times", [False, True])
@pytest.mark.parametrize("tags", [("level", "flow"), ("level", "flow", "temp")])
def test_rows_of_several_tags_are_several_signals_whatever_the_headers(
    tags: tuple[str, ...],
    own_times: bool,
    by_tag: bool,
    clock: Callable[[float], str],
    headers: tuple[str, ...],
    tmp_path: Path,
) -> None:
    rows = rows_of(tags, own_times=own_times, by_tag=by_tag)
    text = write(headers, [(clock(time), tag, value) for time, tag, value in rows])
    check(read(tmp_path, text), rows)
    check(read(tmp_path, text, tags), rows)
    with pytest.raises(InputError, match=r"expected rows of the tags .* got .*'level'.*--tag NAME"):
        read(tmp_path, text, [headers[2]])


def test_further_columns_do_not_hide_the_tags(tmp_path: Path) -> None:
    for own_times in (False, True):
        rows = rows_of(("level", "flow"), own_times=own_times, by_tag=False)
        units = {"level": ("m", 3), "flow": ("m3/h", 4)}
        wide = [
            (
                *(number, "site A", stamp(time), tag, value, *units[tag], "anna" if number % 60 < 30 else "bob"),
                *("" if number % 20 else f"seen {number}", number // 50, 0),
            )
            for number, (time, tag, value) in enumerate(rows)
        ]
        header = ("id", "site", "ts", "what", "x", "unit", "rank", "operator", "remark", "lot", "n")
        check(read(tmp_path, write(header, wide)), rows)


def _influx(rows: Sequence[Row], *, tables: int) -> str:
    """Annotated CSV of InfluxDB, with a header for each table."""
    head = (
        "#group,false,false,true,true,false,false,true,true\n"
        "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string\n"
        "#default,_result,,,,,,,\n"
    )
    header = ("", "result", "table", "_start", "_stop", "_time", "_value", "_field", "_measurement")
    ends = ("2026-05-08T19:00:00Z", "2026-05-09T19:00:00Z")
    tags = list(dict.fromkeys(tag for _, tag, _ in rows))
    lines = [("", "", tags.index(tag), *ends, stamp(time), value, tag, "plant") for time, tag, value in rows]
    parts = [lines] if tables == 1 else [[line for line in lines if line[2] == table] for table in range(len(tags))]
    return "\n".join(head + write(header, part) for part in parts)


FORMS: dict[str, Callable[[Sequence[Row]], str]] = {
    "InfluxDB, one table": lambda rows: _influx(rows, tables=1),
    "InfluxDB, annotated tables": lambda rows: _influx(rows, tables=2),
    "TimescaleDB": lambda rows: write(("time", "metric", "value"), [(stamp(t), tag, v) for t, tag, v in rows]),
    "pandas melt": lambda rows: write(
        ("", "time", "variable", "value"), [(number, stamp(t), tag, v) for number, (t, tag, v) in enumerate(rows)]
    ),
    "PI": lambda rows: write(("Tag", "Timestamp", "Value"), [(tag, german(t), v) for t, tag, v in rows]),
    "German": lambda rows: write(
        ("Zeitpunkt", "Größe", "Messwert"), [(german(t), tag, str(v).replace(".", ",")) for t, tag, v in rows], ";"
    ),
    "a tag with its description": lambda rows: write(
        ("ts", "code", "text", "x"), [(stamp(t), tag, f"{tag} of the tank", v) for t, tag, v in rows]
    ),
    "no header": lambda rows: write((stamp(-1), "flow", "30.1"), [(stamp(t), tag, v) for t, tag, v in rows]),
    "newest first": lambda rows: write(("ts", "what", "x"), [(stamp(t), tag, v) for t, tag, v in rows[::-1]]),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("by_tag", [False, True])
def test_long_tables_as_databases_write_them_are_read_by_tag(form: str, by_tag: bool, tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=False, by_tag=by_tag)
    text = FORMS[form](rows)
    check(read(tmp_path, text), [(-1.0, "flow", 30.1), *rows] if form == "no header" else rows)


def test_parts_of_a_tag_in_two_columns_are_joined(tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=False, by_tag=False)
    for devices in (("A", "B"), ("1", "2")):
        lines = [
            (stamp(time), device, tag, value + 5 * number)
            for time, tag, value in rows
            for number, device in enumerate(devices)
        ]
        record = read(tmp_path, write(("time", "device_id", "metric", "value"), lines))
        means = {name: round(float(np.mean(values))) for name, values in record.columns.items()}
        assert len(means) == 4
        assert sorted(means.values()) == [2, 7, 30, 35]


def test_tags_that_are_numbers_are_read_where_rows_share_their_times(tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=False, by_tag=False)
    lines = [(stamp(time), {"level": 101, "flow": 102}[tag], value) for time, tag, value in rows]
    record = read(tmp_path, write(("ts", "sensor_id", "value"), lines))
    assert {name: round(float(np.mean(values))) for name, values in record.columns.items()} == {"101": 2, "102": 30}


def test_tag_and_value_are_stated_by_name_or_number(tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=False, by_tag=False)
    text = write(
        ("ts", "kind", "what", "x", "y"),
        [(stamp(time), f"k{number % 3}", tag, value, 1.5 * number) for number, (time, tag, value) in enumerate(rows)],
    )
    with pytest.raises(InputError, match=r"expected one column of values .* got 'x', 'y'; state --value NAME"):
        read(tmp_path, text)
    check(read(tmp_path, text, value="x"), rows)
    check(read(tmp_path, text, tag="what", value="4"), rows)
    assert set(read(tmp_path, text, tag="kind,what", value="x").columns) == {
        f"k{number}.{tag}" for number in range(3) for tag in ("level", "flow")
    }
    for option in ("tag", "value"):
        with pytest.raises(InputError, match=rf"row 1: expected a column 'wat' \(--{option}\), got .*'what'"):
            read(tmp_path, text, **{option: "wat"})
    with pytest.raises(InputError, match="--tag and --value must name different columns, got 'x' and '4'"):
        read(tmp_path, text, tag="x", value="4")
    with pytest.raises(InputError, match="--tag and --value need a time column, got --period '4 s'"):
        FileFormat(tag="what", period="4 s")


WIDE: dict[str, Callable[[int], tuple[Sequence[str], Sequence[Cell]]]] = {
    "a valve that opens and closes": lambda k: (
        ("time", "valve", "T"),
        (stamp(10 * k), ("open", "closed")[k // 3 % 2], 80 - 70 * (k // 3 % 2) + k % 7 / 10),
    ),
    "batches on a clock": lambda k: (("time", "batch", "T"), (stamp(10 * k), f"B{k // 30}", 80 + k % 7 / 10)),
    "batches that start at 0": lambda k: (("time_min", "batch", "T"), (k % 30, f"B{k // 30}", 80 + k % 7 / 10)),
    "shifts": lambda k: (("time", "operator", "T"), (stamp(10 * k), ("anna", "bob")[k // 40 % 2], 80 + k % 7 / 10)),
    "a remark here and there": lambda k: (
        ("time", "remark", "T"),
        (stamp(10 * k), "" if k % 9 else "seen", 80 + k % 7 / 10),
    ),
    "rows that are counted": lambda k: (("id", "phase", "T"), (k, ("heat", "cool")[k % 2], 80 + k % 7 / 10)),
    "a time with the name of a sensor": lambda k: (
        ("sensor_ts", "phase", "T"),
        (1_780_000_000 + 10 * k, ("heat", "cool")[k % 2], 80 + k % 7 / 10),
    ),
    "several columns of numbers": lambda k: (
        ("time", "phase", "T", "C"),
        (stamp(10 * k), ("heat", "cool")[k % 2], 80 + k % 7 / 10, k % 5 / 10),
    ),
    "another column with a word": lambda k: (
        ("time", "phase", "T", "C"),
        (stamp(10 * k), ("heat", "cool")[k % 2], 80 + k % 7 / 10, "oops" if k > 80 else k % 5 / 10),
    ),
}


@pytest.mark.parametrize("form", WIDE)
def test_a_label_beside_the_signals_of_a_row_is_no_tag(form: str, tmp_path: Path) -> None:
    header = WIDE[form](0)[0]
    record = read(tmp_path, write(header, [WIDE[form](row)[1] for row in range(ROWS)]), ["T"])
    assert record.rows == ROWS
    assert record.columns["T"].tolist() == pytest.approx([WIDE[form](row)[1][2] for row in range(ROWS)])


def test_the_tag_none_states_that_a_table_is_wide(tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=True, by_tag=False)
    text = write(("time", "what", "x"), [(stamp(time), tag, value) for time, tag, value in rows])
    assert read(tmp_path, text, ["x"], tag="none").columns["x"].tolist() == [value for *_, value in rows]


def test_rows_of_several_machines_that_share_their_times_are_not_mixed(tmp_path: Path) -> None:
    rows = rows_of(("level", "flow"), own_times=False, by_tag=False)
    text = write(("time", "machine", "T", "p"), [(stamp(t), tag, v, 1.5 * n) for n, (t, tag, v) in enumerate(rows)])
    with pytest.raises(InputError, match=r"expected one column of values for the tags of 'machine'.*--value NAME"):
        read(tmp_path, text, ["T"])
    check(read(tmp_path, text, value="T"), rows)
