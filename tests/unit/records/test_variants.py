"""Files as they come: variants of one record read to the same numbers and times, and ambiguous ones are refused."""

from pathlib import Path

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import Record, join_files, join_runs
from tests.unit.records.variants import (
    BERLIN,
    HOLES,
    MINUTES,
    ROWS,
    STAMPS,
    START,
    SUMMER_ENDS,
    UNITS,
    VALUES,
    VARIANTS,
    WINTER_ENDS,
    Variant,
    cells,
    clock,
    table,
)


def read(folder: Path, variant: Variant) -> Record:
    path = folder / f"record{variant.suffix}"
    path.write_bytes(variant.content)
    signals = [SignalColumn(name, unit, column=variant.names.get(name)) for name, unit in UNITS.items()]
    return read_table(path, signals, variant.stated)


def assert_same(record: Record, variant: Variant) -> None:
    assert record.rows == ROWS
    np.testing.assert_allclose(record.time_min - variant.first_min, np.arange(ROWS), rtol=0, atol=1e-9)
    for number, name in enumerate(UNITS):
        expected = np.where(HOLES[:, number] & variant.has_holes, np.nan, VALUES[:, number])
        np.testing.assert_allclose(record.columns[name], expected, rtol=0, atol=1e-9, err_msg=name)
    assert record.units == UNITS
    assert record.zero_ns == (0 if variant.start is None else round(variant.start.timestamp() * 1000) * 1_000_000)
    assert record.runs is None
    assert record.strays == 0


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_reads_to_the_numbers_times_and_units_of_the_record(tmp_path: Path, name: str) -> None:
    assert_same(read(tmp_path, VARIANTS[name]), VARIANTS[name])


@pytest.mark.parametrize(
    "name", [name for name, variant in VARIANTS.items() if not variant.names and name != "other names"]
)
def test_without_a_mapping_columns_have_their_own_names(tmp_path: Path, name: str) -> None:
    variant = VARIANTS[name]
    path = tmp_path / f"record{variant.suffix}"
    path.write_bytes(variant.content)
    record = read_table(path, None, variant.stated)
    np.testing.assert_allclose(record.time_min - variant.first_min, np.arange(ROWS), rtol=0, atol=1e-9)
    assert set(UNITS) <= set(record.columns) <= {*UNITS, "n2", "Comment"}


def test_a_parquet_file_reads_like_its_text(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    stamps = pa.array(clock(), pa.timestamp("ms", tz="Europe/Berlin"))
    columns = {
        name: pa.array(np.where(HOLES[:, number], np.nan, VALUES[:, number])) for number, name in enumerate(UNITS)
    }
    parquet.write_table(pa.table({"timestamp": stamps, **columns}), tmp_path / "record.parquet")
    content = (tmp_path / "record.parquet").read_bytes()
    assert_same(read(tmp_path, Variant(content, ".parquet")), Variant(b"", has_holes=True, start=START))


GUESSES = {
    "plain": "",
    "seconds": "",
    "decimal comma and semicolons": "; separated, decimal comma",
    "a name that says nothing": "time `ts` in s",
    "a German date": "; separated, decimal comma, time `Zeit` dd.mm.yyyy hh:mm:ss in Europe/Berlin",
    "a British date": "time `Zeit` dd/mm/yyyy hh:mm:ss, time zone unknown, taken as UTC",
    "no header": "no header, time `1` in min",
    "units that differ": "T from degC to K",
    "more columns, and text": "",
    "rows and columns exchanged": "rows and columns exchanged",
    "German Excel": "Windows-1252, ; separated, decimal comma, header in row 4, "
    "time `Zeit` dd.mm.yyyy hh:mm:ss in Europe/Berlin",
    "newest row first": "newest row first",
    "a line of text at the end": "lines of text left out: 1, such as `(240 rows affected)`",
    "a header that is repeated": "repeated headers left out: 1",
    "long": "time `timestamp` yyyy-mm-dd hh:mm:ss, a row for each value of `value` by `tag`",
}


@pytest.mark.parametrize("name", GUESSES)
def test_each_guess_is_named_and_a_plain_file_has_none(tmp_path: Path, name: str) -> None:
    assert read(tmp_path, VARIANTS[name]).read_as == GUESSES[name]


FALLS = [time.astimezone(BERLIN).strftime("%Y-%m-%d %H:%M:%S") for time in clock(SUMMER_ENDS)]
BEGINS = [time.strftime("%Y-%m-%d %H:%M:%S") for time in clock(WINTER_ENDS)]
STATED_BERLIN = FileFormat(zone="Europe/Berlin")
REFUSED = {
    "two times": (
        table([f"{item},{item}" for item in MINUTES], cells(), ("time", "elapsed", "qc", "C", "T")),
        FileFormat(),
        "2 columns could be the time: 'time', 'elapsed'; state --time NAME",
    ),
    "two timestamps": (
        table([f"{item},{item}" for item in BEGINS], cells(), ("sent", "received", "qc", "C", "T")),
        FileFormat(),
        "2 columns could be the time: 'sent', 'received'; state --time NAME",
    ),
    "no time": (
        table([row[0] for row in cells()], cells(), ("p", "qc", "C", "T")),
        FileFormat(),
        "or another that looks like a time, got 'p', 'qc', 'C', 'T'; state --time NAME, or --period",
    ),
    "a comma that may be a thousand": (
        table(MINUTES, [["1,034", "2,100", "4,385"]] * ROWS, separator=";"),
        FileFormat(),
        "row 2: '1,034' may have a decimal comma (--decimal ,) or group its thousands (--decimal .); state one of them",
    ),
    "the comma twice": (
        table([f"{item},0" for item in MINUTES], [[cell.replace(".", ",") for cell in row] for row in cells()]),
        FileFormat(),
        "row 2: expected 4 cells as in the header, got 8; if the comma is the decimal sign as well, state --decimal ,",
    ),
    "columns of text": (
        table(MINUTES, [["low", "high", "high"]] * ROWS),
        FileFormat(),
        "row 2, column 'qc': expected a finite number or nothing, got 'low'; --missing low reads it as not measured",
    ),
    "a column of text": (
        table(MINUTES, [[row[0], "high", row[2]] for row in cells()]),
        FileFormat(),
        "row 2, column 'C': expected a finite number or nothing, got 'high'; --missing high reads it as not measured",
    ),
    "two decimal signs": (
        table(
            MINUTES,
            [["100,5", "0,11", "438.2" if row[0] == "7" else "438,2"] for row in zip(MINUTES, strict=True)],
            separator=";",
        ),
        FileFormat(),
        "row 9, column 'T': expected a finite number or nothing, got '438.2'; state --decimal if its sign is another",
    ),
    "a day or a month": (
        table([f"03/04/2026 10:{row // 60:02d}:{row % 60:02d}" for row in range(ROWS)], cells(), STAMPS),
        FileFormat(),
        "day and month are ambiguous in all rows, such as '03/04/2026 10:00:00'; state --dates month-first or --dates",
    ),
    "summer time ends, no zone": (
        table(FALLS, cells(), STAMPS),
        FileFormat(),
        "row 122, column 'Zeit': expected increasing times; the clock steps back by an hour, "
        "as at the end of summer time, got '2026-10-25 02:00:00'; state the zone, such as --zone Europe/Berlin",
    ),
    "an hour of summer or of winter time": (
        table(FALLS[130:170], cells()[:40], STAMPS),
        STATED_BERLIN,
        "row 2, column 'Zeit': expected a time that is unique in Europe/Berlin",
    ),
    "an hour that does not exist": (
        table([time.replace("2026-03-28 23", "2026-03-29 02") for time in BEGINS[:60]], cells()[:60], STAMPS),
        STATED_BERLIN,
        "row 2, column 'Zeit': expected a time that exists in Europe/Berlin",
    ),
    "a wrong format": (
        table(BEGINS, cells(), STAMPS),
        FileFormat(time_format="%d.%m.%Y %H:%M"),
        "row 2, column 'Zeit': expected a time of the form %d.%m.%Y %H:%M, got '2026-03-28 23:00:00'; "
        "state --time-format",
    ),
    "a unit of another quantity": (
        table(MINUTES, cells(), ("time_min", "qc", "C", "T [bar]")),
        FileFormat(),
        "column 'T [bar]': unit must convert to 'K', got 'bar'; correct the header",
    ),
    "a column that is not there": (
        table(MINUTES, cells()),
        FileFormat(time="clock"),
        "expected a column 'clock' (--time), got 'time_min', 'qc', 'C', 'T'",
    ),
    "the wrong separator": (
        table(MINUTES, cells()),
        FileFormat(separator=";"),
        "the cells must be separated, such as by commas (--separator)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_can_be_read_in_several_ways_is_refused_with_the_option_that_decides(tmp_path: Path, name: str) -> None:
    text, stated, line = REFUSED[name]
    with pytest.raises(InputError) as refused:
        read(tmp_path, Variant(text.encode(), stated=stated))
    assert line in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "record.csv"))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "stated"),
    [
        ("two times", FileFormat(time="elapsed", time_unit="min")),
        ("no time", FileFormat(period="1 min")),
        ("a comma that may be a thousand", FileFormat(decimal=",")),
        ("a comma that may be a thousand", FileFormat(decimal=".")),
        ("the comma twice", FileFormat(decimal=",")),
        ("columns of text", FileFormat(missing=("low", "high"))),
        ("a day or a month", FileFormat(dates="day-first")),
        ("a day or a month", FileFormat(dates="month-first")),
        ("a day or a month", FileFormat(time_format="%d/%m/%Y %H:%M:%S")),
        ("a day or a month", FileFormat(time_format="%m/%d/%Y %H:%M:%S")),
        ("summer time ends, no zone", FileFormat(zone="Europe/Berlin")),
        ("an hour of summer or of winter time", FileFormat(zone="+01:00")),
        ("an hour that does not exist", FileFormat(zone="UTC")),
        ("the wrong separator", FileFormat(separator=",")),
    ],
)
def test_the_option_that_is_named_settles_it(tmp_path: Path, name: str, stated: FileFormat) -> None:
    record = read(tmp_path, Variant(REFUSED[name][0].encode(), stated=stated))
    assert (np.diff(record.time_min) > 0).all()


@pytest.mark.parametrize(
    ("stated", "line"),
    [
        ({"time_unit": "weeks"}, "unknown --time-unit 'weeks'"),
        ({"decimal": ";"}, r"--decimal must be '\.' or ',', got ';'"),
        ({"separator": "ab"}, "--separator must be one character, 'tab' or 'blank', got 'ab'"),
        ({"separator": ",", "decimal": ","}, "--separator and --decimal must differ"),
        ({"period": "4"}, "--period must be a positive number with its unit, such as 4 s, got '4'"),
        ({"period": "-4 s"}, "--period must be a positive number"),
        ({"time_format": "%Y-%Q"}, "--time-format '%Y-%Q': unknown directive '%Q'"),
        ({"time_format": "%Y-%Y"}, "--time-format '%Y-%Y': each part once"),
        ({"dates": "us"}, "unknown --dates 'us'.*month-first"),
        ({"zone": "Mars/Olympus"}, "--zone must be a time zone such as Europe/Berlin"),
    ],
)
def test_a_statement_that_means_nothing_is_refused(stated: dict[str, str], line: str) -> None:
    with pytest.raises(InputError, match=line):
        FileFormat(**stated)  # type: ignore[arg-type]


def test_the_time_column_that_is_read_as_a_signal_is_named(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_text(table(MINUTES, cells()))
    with pytest.raises(InputError, match="'T', of which 'time_min' is read as a signal; state --time NAME"):
        read_table(path, [SignalColumn("C"), SignalColumn("T", column="time_min")])


def test_two_signals_of_one_column_are_refused(tmp_path: Path) -> None:
    """By its name and by its number."""
    path = tmp_path / "record.csv"
    path.write_text(table(MINUTES, cells()))
    line = "each signal must have a column of its own, got column 3, 'C', for C and T; leave one out"
    with pytest.raises(InputError, match=line):
        read_table(path, [SignalColumn("C"), SignalColumn("T", column="3")])


def test_a_name_that_occurs_twice_is_refused_where_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_text("time_min,p,T,T\n0,1,2,3\n1,2,3,4\n")
    for signals in (None, [SignalColumn("T")]):
        with pytest.raises(InputError, match="once, got 'T' more than once; name it by its number, as in column = 3"):
            read_table(path, signals)
    assert read_table(path, [SignalColumn("p"), SignalColumn("T", column="4")]).columns["T"].tolist() == [3.0, 4.0]


def test_modes_and_labels_may_be_words(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_text("time_min,T,mode\n0,1,manual\n1,2,auto\n2,3,manual\n3,4,\n")
    record = read_table(path, [SignalColumn("T", "K"), SignalColumn("mode", role="mode")])
    np.testing.assert_array_equal(record.columns["mode"], [0, 1, 0, np.nan])
    assert record.read_as == "mode: manual = 0, auto = 1"


def test_files_in_a_row_are_one_record(tmp_path: Path) -> None:
    times = [time.isoformat() for time in clock()]
    paths = []
    for number, part in enumerate((slice(0, 100), slice(100, ROWS))):
        paths.append(tmp_path / f"{number}.csv")
        paths[-1].write_text(table(times[part], cells()[part], STAMPS))
    signals = [SignalColumn(name, unit) for name, unit in UNITS.items()]
    record = join_files([read_table(path, signals) for path in paths])
    assert_same(record, Variant(b"", start=START))
    turned = join_files([read_table(path) for path in paths[::-1]])
    assert turned.runs is not None
    assert [run.rows for run in turned.split_runs()] == [ROWS - 100, 100]
    assert turned.time_min[0] == 0.0
    assert turned.time_min[ROWS - 100] == -100.0


def test_a_file_of_several_runs_continues_where_the_one_before_ended() -> None:
    def part(*times: float) -> Record:
        return Record(np.array(times), {"T": np.array(times)}, "part")

    whole = join_files([part(0, 1, 2), join_runs([part(3, 4, 5), part(1, 2)]), part(3, 4)])
    assert [run.time_min.tolist() for run in whole.split_runs()] == [[0, 1, 2, 3, 4, 5], [1, 2, 3, 4]]
    assert whole.columns["T"].tolist() == [0, 1, 2, 3, 4, 5, 1, 2, 3, 4]


def test_files_of_other_units_or_clocks_are_no_record() -> None:
    times = np.arange(3.0)
    record = Record(times, {"T": times}, "a", units={"T": "K"})
    with pytest.raises(InputError, match="b: expected the units of a"):
        join_files([record, Record(times + 3, {"T": times}, "b", units={"T": "degC"})])
    with pytest.raises(InputError, match="b: expected no clock time, as a has"):
        join_files([record, Record(times + 3, {"T": times}, "b", zero_ns=1, units={"T": "K"})])


def test_files_of_other_signals_are_no_record(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text(f"time_min,{name}\n0,1\n1,2\n")
    with pytest.raises(InputError, match=r"b\.csv: expected the signals of a\.csv, a, got b"):
        join_files([read_table(tmp_path / f"{name}.csv") for name in ("a", "b")])


def test_values_may_be_changed_in_place(tmp_path: Path) -> None:
    (tmp_path / "record.csv").write_text("time_min,qc,T\n0,1,2\n1,1,2\n", encoding="utf-8")
    record = read_table(tmp_path / "record.csv")
    for values in (record.time_min, *record.columns.values()):
        values[1:] += 1.0
    assert record.columns["T"].tolist() == [2.0, 3.0]
