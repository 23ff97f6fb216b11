"""Qualities of values: the systems that write them, and what is left out."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.description.toml_file import parse_process, to_tables
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.historian import judge
from reactorwatch.records.read import SignalColumn, read_table
from reactorwatch.records.record import Record

ROWS = 40
BAD = slice(10, 16)

KINDS = [
    ("Good", "Bad"),
    ("Good", "Uncertain"),
    ("Good", "Questionable"),
    ("Good", "Doubtful"),
    ("Good", "Bad Input"),
    ("Good", "I/O Timeout"),
    ("Good", "No Data"),
    ("Good", "not good"),
    ("Good", ""),
    ("Good", "0"),
    ("Good", "64"),
    ("GOOD", "SUSPECT"),
    ("Good, Non-specific", "Bad, Not Connected"),
    ("Good [Local Override]", "Uncertain [Last Usable]"),
    ("GoodLocalOverride", "BadNoCommunication"),
    ("Good_Clamped", "Uncertain_SensorNotAccurate"),
    ("OPC_QUALITY_GOOD", "OPC_QUALITY_BAD"),
    ("ihOPCGood", "ihOPCUncertain"),
    ("OK (0x0)", "StatusBadNodeIDUnknown (0x80340000)"),
    ("OK", "Error"),
    ("valid", "invalid"),
    ("no error", "error"),
    ("gut", "schlecht"),
    ("gültig", "ungültig"),
    ("i.O.", "n.i.O."),
    ("in Ordnung", "gestört"),
    ("192", "0"),
    ("192", "64"),
    ("192", "24"),
    ("216", "28"),
    ("219", "88"),
    ("192.0", "0.0"),
    ("192", "500"),
    ("0", "2147483648"),
    ("0", "-2147483648"),
    ("0", "1073741824"),
    ("0", "-2147155968"),
    ("3014656", "2150891520"),
    ("0x00000000", "0x80050000"),
    ("0x000000C0", "0x00000018"),
    ("true", "false"),
    ("TRUE", "FALSE"),
]
"""A good and another quality as OPC UA, OPC DA, PI, Proficy, InSQL, Ignition, Seeq and people write them."""

UNKNOWN = [
    ("0", "0"),
    ("0", "1"),
    ("1", "1"),
    ("100", "100"),
    ("0", "64"),
    ("192", "-1"),
    ("Good", "Anna"),
    ("Good", "last good"),
    ("A", "B"),
    ("Good", "0.97"),
    ("", "Bad"),
    ("Bad", "Bad"),
]
"""Qualities that are of no known system, or of two with opposite meanings, or of which none is good."""


def cell(pair: tuple[str, str], row: int) -> str:
    return f'"{pair[1 if BAD.start <= row < BAD.stop else 0]}"'


def read_long(folder: Path, pair: tuple[str, str], header: str = "Quality", **stated: tuple[str, ...]) -> Record:
    lines = [
        f"2026-03-01T08:{row:02d}:00Z,{tag},{row + 100 * number}.5,{cell(pair, row)}"
        for row in range(ROWS)
        for number, tag in enumerate(("LI-1", "FI-2"))
    ]
    return read_text(folder, [f"Time,Tag,Value,{header}", *lines], **stated)


def read_wide(
    folder: Path, header: str, cells: list[str], signals: tuple[str, ...] = (), **stated: tuple[str, ...]
) -> Record:
    lines = [f"{row},{row}.5,{200 - row}.25,{text}" for row, text in enumerate(cells)]
    return read_text(folder, [f"time_min,{header}", *lines], signals, **stated)


def read_text(folder: Path, lines: list[str], signals: tuple[str, ...] = (), **stated: tuple[str, ...]) -> Record:
    file = folder / "plant.csv"
    file.write_text("\n".join(lines) + "\n")
    return read_table(file, [SignalColumn(name) for name in signals] or None, FileFormat(**stated))  # type: ignore[arg-type]


def excluded(record: Record, signal: str) -> list[int]:
    return np.flatnonzero(np.isnan(record.columns[signal])).tolist()


@pytest.mark.parametrize("pair", KINDS, ids=map(str, KINDS))
def test_values_of_another_quality_than_good_are_excluded_from_a_long_table(
    pair: tuple[str, str], tmp_path: Path
) -> None:
    record = read_long(tmp_path, pair)
    assert excluded(record, "LI-1") == excluded(record, "FI-2") == list(range(ROWS))[BAD]
    assert "quality `Quality` excludes 12 of 80 values" in record.read_as


@pytest.mark.parametrize("header", ["T_quality", "T.Quality", "Quality T", "T Qualität", "TQuality"])
@pytest.mark.parametrize("pair", KINDS, ids=map(str, KINDS))
def test_values_of_another_quality_than_good_are_excluded_from_their_column(
    pair: tuple[str, str], header: str, tmp_path: Path
) -> None:
    cells = [cell(pair, row) for row in range(ROWS)]
    for signals in ((), ("T", "C")):
        record = read_wide(tmp_path, f"T,C,{header}", cells, signals)
        assert list(record.columns) == ["T", "C"]
        assert excluded(record, "T") == list(range(ROWS))[BAD]
        assert not excluded(record, "C")
        assert f"quality `{header}` excludes 6 of 40 values" in record.read_as


@pytest.mark.parametrize("header", ["T_status", "T.Status", "T_flag", "T_q", "T_QC", "T.Valid"])
@pytest.mark.parametrize("pair", [("Good", "Bad"), ("192", "24"), ("gut", "schlecht")])
def test_a_state_named_good_is_a_quality(pair: tuple[str, str], header: str, tmp_path: Path) -> None:
    record = read_wide(tmp_path, f"T,qc,{header}", [cell(pair, row) for row in range(ROWS)])
    assert excluded(record, "T") == list(range(ROWS))[BAD]
    assert not excluded(record, "qc")


@pytest.mark.parametrize("header", ["Quality", "OPCQuality", "Data quality", "Qualität", "Status"])
@pytest.mark.parametrize("pair", [("Good", "Bad"), ("192", "24")])
def test_a_quality_without_a_signal_is_that_of_the_row(pair: tuple[str, str], header: str, tmp_path: Path) -> None:
    record = read_wide(tmp_path, f"T [K],C [mol/l],{header}", [cell(pair, row) for row in range(ROWS)])
    assert excluded(record, "T") == excluded(record, "C") == list(range(ROWS))[BAD]
    assert f"quality `{header}` excludes 12 of 80 values" in record.read_as


def test_repeated_columns_of_qualities_are_about_the_column_before_each(tmp_path: Path) -> None:
    lines = [f"{row},1.5,{'Bad' if row < 3 else 'Good'},2.5,{'Good' if row < 9 else 'Bad'}" for row in range(ROWS)]
    record = read_text(tmp_path, ["time_min,T,Status,C,Status", *lines])
    assert excluded(record, "T") == [0, 1, 2]
    assert excluded(record, "C") == list(range(9, ROWS))


@pytest.mark.parametrize("pair", UNKNOWN, ids=map(str, UNKNOWN))
def test_an_unknown_quality_is_refused_with_the_option_that_states_it(pair: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"plant.csv, row \d+, column 'Quality': expected .* --quality-good "):
        read_long(tmp_path, pair)
    stated = read_long(tmp_path, pair, quality_good=(pair[0],))
    assert excluded(stated, "LI-1") == ([] if pair[0] == pair[1] else list(range(ROWS))[BAD])
    assert not excluded(read_long(tmp_path, pair, quality_good=("*",)), "LI-1")


@given(good=st.integers(192, 255), other=st.integers(0, 127))
def test_codes_of_opc_da_are_good_from_192(good: int, other: int) -> None:
    assert judge([str(good), str(other)], "Quality", FileFormat()) == {str(good): True, str(other): False}


@given(st.integers(1 << 30, (3 << 30) - 1), st.booleans(), st.booleans())
def test_codes_of_opc_ua_are_good_at_0(other: int, is_signed: bool, is_hexadecimal: bool) -> None:
    text = f"0x{other:08X}" if is_hexadecimal else str(other - (1 << 32) if is_signed and other >> 31 else other)
    assert judge(["0", text], "Quality", FileFormat()) == {"0": True, text: False}


@pytest.mark.parametrize(
    ("header", "cells", "good"),
    [
        ("StatusCode", ["0"], [True]),
        ("OPCQuality", ["0"], [False]),
        ("QualityDetail", ["192", "0"], [True, False]),
        ("Questionable", ["False", "True"], [True, False]),
        ("IsGood", ["True", "False"], [True, False]),
        ("Good", ["1", "0"], [True, False]),
        ("Bad quality", ["1", "0"], [False, True]),
    ],
)
def test_a_header_defines_codes_and_flags(header: str, cells: list[str], good: list[bool]) -> None:
    assert list(judge(cells, header, FileFormat()).values()) == good


def test_a_value_needs_all_of_its_qualities(tmp_path: Path) -> None:
    lines = [f"2026-03-01T08:{row:02d}:00Z,LI-1,{row}.5,{row != 3},{row == 5}" for row in range(ROWS)]
    record = read_text(tmp_path, ["Timestamp,Tag,Value,Good,Questionable", *lines])
    assert excluded(record, "LI-1") == [3, 5]


def test_the_quality_of_insql_is_read_beside_its_detail(tmp_path: Path) -> None:
    lines = [
        f"LI-1,2026-03-01T08:{row:02d}:00Z,{row}.5,,{int(row == 3)},{24 if row == 3 else 192},EXTENDED,9"
        for row in range(9)
    ]
    header = "TagName,DateTime,Value,vValue,Quality,QualityDetail,wwQualityRule,wwTagKey"
    assert excluded(read_text(tmp_path, [header, *lines]), "LI-1") == [3]


@pytest.mark.parametrize(
    ("header", "cells"),
    [
        ("machine_status", ["NORMAL", "BROKEN"]),
        ("status", ["ok", "fault"]),
        ("status", ["running", "stopped"]),
        ("air_quality", ["17", "45"]),
        ("steam_quality", ["0.97", "0.5"]),
        ("valve_status", ["0", "1"]),
    ],
)
def test_the_state_of_a_machine_and_a_measured_quality_exclude_nothing(
    header: str, cells: list[str], tmp_path: Path
) -> None:
    record = read_wide(tmp_path, f"T,C,{header}", [cells[row > 30] for row in range(ROWS)])
    assert not excluded(record, "T")
    assert "quality" not in record.read_as.replace(header, "")


def test_a_quality_that_is_asked_for_is_a_signal(tmp_path: Path) -> None:
    record = read_wide(tmp_path, "T,C,quality", [str(row % 7) for row in range(ROWS)], ("T", "quality"))
    assert record.columns["quality"].tolist() == [row % 7 for row in range(ROWS)]


def test_an_unknown_quality_of_a_column_that_is_not_read_does_not_matter(tmp_path: Path) -> None:
    assert not excluded(read_wide(tmp_path, "T,C,T_quality", ["Anna"] * ROWS, ("C",)), "C")


def test_stated_codes_of_a_flag_are_read_beside_a_label(tmp_path: Path) -> None:
    record = read_wide(
        tmp_path, "T,C,T_flag,phase", [f"{int(row < 3)},heat" for row in range(ROWS)], quality_good=("0",)
    )
    assert excluded(record, "T") == [0, 1, 2]


def test_stated_qualities_need_a_column_of_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"row 1: expected a column of qualities \(--quality-good\)"):
        read_wide(tmp_path, "T,C,remark", ["Good"] * ROWS, quality_good=("Good",))


def test_a_process_states_qualities_and_columns_in_its_file_table() -> None:
    text = b"""
    name = "tank"
    signals = [{name = "h", role = "output"}]
    [file]
    tag = "what"
    value = 3
    quality_good = ["A", 7]
    """
    process = parse_process(text, lambda name: pytest.fail(name))
    stated = process.file_format
    assert (stated.tag, stated.value, stated.quality_good) == ("what", "3", ("A", "7"))
    assert to_tables(process)["file"] == {"tag": "what", "value": "3", "quality_good": ("A", "7")}
