# ruff: noqa: E501 # a variant a line
"""One record as plants, spreadsheets and programs write it: the variants that have to read to the same numbers."""

import csv
import gzip
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, timezone
from zoneinfo import ZoneInfo

import numpy as np

from reactorwatch.records.file_format import FileFormat

ROWS = 240
PERIOD_S = 60
BERLIN = ZoneInfo("Europe/Berlin")
START = datetime(2026, 3, 1, 8, 0, tzinfo=UTC)
WINTER_ENDS = datetime(2026, 3, 28, 23, 0, tzinfo=UTC)
SUMMER_ENDS = datetime(2026, 10, 24, 23, 0, tzinfo=UTC)
UNITS = {"qc": "l/min", "C": "mol/l", "T": "K"}

_noise = np.random.default_rng(5).normal(size=(ROWS, 3))
VALUES = np.round(_noise * [4.0, 0.004, 1.2] + [103.4, 0.1, 438.5], 4)
HOLES = np.random.default_rng(6).random((ROWS, 3)) < 0.03
HOLES[0] = False


@dataclass(frozen=True)
class Variant:
    """A file, and all that has to be stated to read it.

    Attributes:
        content: bytes of the file.
        suffix: ending of its name.
        stated: statements about it.
        has_holes: some values are missing.
        start: clock time of the first row; None: the file has none.
        names: columns of the signals, where they have other names.
        first_min: minutes of the first row.
    """

    content: bytes
    suffix: str = ".csv"
    stated: FileFormat = field(default_factory=FileFormat)
    has_holes: bool = False
    start: datetime | None = None
    names: dict[str, str] = field(default_factory=dict)
    first_min: float = 0.0


def clock(start: datetime = START) -> list[datetime]:
    return [start + timedelta(seconds=PERIOD_S * row) for row in range(ROWS)]


def cells(hole: str | None = None, form: str = "{:.4f}") -> list[list[str]]:
    """Values as text, rows of qc, C, T; `hole` stands for those that are missing, None: none are."""
    return [
        [hole if hole is not None and HOLES[row, column] else form.format(VALUES[row, column]) for column in range(3)]
        for row in range(ROWS)
    ]


def table(
    times: Sequence[str],
    values: Sequence[Sequence[str]],
    header: Sequence[str] = ("time_min", "qc", "C", "T"),
    separator: str = ",",
    above: Sequence[str] = (),
    below: Sequence[str] = (),
) -> str:
    """Text of a table: lines above the header, the header, lines below it, and the rows."""
    rows = [separator.join([time, *row]) for time, row in zip(times, values, strict=True)]
    lines = [*above, *([separator.join(header)] if header else []), *below, *rows]
    return "\n".join(lines) + "\n"


def commas(values: Iterable[Iterable[str]]) -> list[list[str]]:
    return [[cell.replace(".", ",") for cell in row] for row in values]


MINUTES = [str(row) for row in range(ROWS)]
SECONDS = [str(60 * row) for row in range(ROWS)]
STAMPS = ("Zeit", "qc", "C", "T")


def _stamps(form: str, start: datetime = START, zone: timezone | ZoneInfo = UTC) -> list[str]:
    return [time.astimezone(zone).strftime(form) for time in clock(start)]


def _iso(start: datetime, zone: timezone | ZoneInfo = UTC) -> list[str]:
    return [time.astimezone(zone).isoformat() for time in clock(start)]


def _text(text: str, **more: object) -> Variant:
    return replace(Variant(text.encode()), **more)  # type: ignore[arg-type]


def _long(form: Callable[[datetime], str], hole: str, header: Sequence[str], separator: str, by_tag: bool) -> str:
    values = cells(hole)
    lines = [
        [form(time), tag, values[row][column], "Bad" if values[row][column] == hole else "Good"]
        for row, time in enumerate(clock())
        for column, tag in enumerate(UNITS)
    ]
    if by_tag:
        lines.sort(key=lambda line: line[1])
    return "\n".join(separator.join(line[: len(header)]) for line in [list(header), *lines]) + "\n"


def _transposed(text: str, separator: str) -> str:
    rows = list(csv.reader(io.StringIO(text), delimiter=separator))
    return "\n".join(separator.join(row) for row in zip(*rows, strict=True)) + "\n"


def _headerless(text: str) -> str:
    return text.partition("\n")[2]


LABVIEW = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t,
***End_of_Header***\t

Channels\t3
Samples\t240
""".splitlines()


def _variants() -> dict[str, Variant]:
    plain = table(MINUTES, cells())
    semicolon = table(MINUTES, commas(cells()), separator=";")
    by_number = {"qc": "2", "C": "3", "T": "4"}
    only_numbers = {"qc": "1", "C": "2", "T": "3"}
    german = _stamps("%d.%m.%Y %H:%M:%S", zone=BERLIN)
    excel = table(
        german,
        [[*row, ""] for row in commas(cells(""))],
        ("Zeit", "Kühlwasser qc [l/min]", "Konzentration C [mol/l]", "Temperatur T [°C]", ""),
        ";",
        above=["Anlage 7;;;;", "Schicht: früh;;;;", ";;;;"],
    )
    kelvin_names = {"qc": "Kühlwasser qc", "C": "Konzentration C", "T": "Temperatur T"}
    celsius = [[row[0], row[1], f"{float(row[2]) - 273.15:.4f}"] for row in cells()]
    unix = [int(time.timestamp()) for time in clock()]
    return {
        "plain": _text(plain),
        "semicolons": _text(table(MINUTES, cells(), separator=";")),
        "tabs": _text(table(MINUTES, cells(), separator="\t"), suffix=".tsv"),
        "blanks": _text(table(MINUTES, cells(), separator="   "), suffix=".dat"),
        "aligned columns": _text(table([f"  {item:>8}" for item in MINUTES], cells(form="{:>16.8e}"), separator=" "), suffix=".txt"),
        "pipes": _text(table(MINUTES, cells(), separator="|"), suffix=".txt"),
        "a comma and a blank": _text(table(MINUTES, cells(), separator=", ")),
        "decimal comma and semicolons": _text(semicolon),
        "decimal comma and tabs": _text(table(MINUTES, commas(cells()), separator="\t"), suffix=".txt"),
        "decimal comma in quotes": _text(table([f'"{item}"' for item in MINUTES], [[f'"{cell}"' for cell in row] for row in commas(cells())])),
        "thousands in groups": _text(table([f"{60000 * row:,}" for row in range(ROWS)], cells(), ("t_ms", "qc", "C", "T"), ";")),
        "thousands in points": _text(table([f"{60000 * row:,}".replace(",", ".") for row in range(ROWS)], commas(cells()), ("t [ms]", "qc", "C", "T"), ";")),
        "seconds": _text(table(SECONDS, cells(), ("time_s", "qc", "C", "T"))),
        "seconds in brackets": _text(table(SECONDS, cells(), ("Time (sec)", "qc", "C", "T"), ", ")),
        "hours": _text(table([repr(row / 60) for row in range(ROWS)], cells(), ("t [h]", "qc", "C", "T"))),
        "a name that says nothing": _text(table(SECONDS, cells(), ("ts", "qc", "C", "T"))),
        "a stated unit": _text(table(MINUTES, cells(), ("t", "qc", "C", "T")), stated=FileFormat(time_unit="min")),
        "a standard name and another unit": _text(table(SECONDS, cells()), stated=FileFormat(time_unit="s")),
        "a row number in seconds": _text(table(SECONDS, cells(), ("sample", "qc", "C", "T"))),
        "a period": _text(table(["x"] * ROWS, cells(), ("remark", "qc", "C", "T")), stated=FileFormat(period="60 s")),
        "a period and no header": _text("\n".join(" ".join(row) for row in cells()) + "\n", stated=FileFormat(period="1min"), names=only_numbers, suffix=".dat"),
        "no header": _text(_headerless(plain), stated=FileFormat(time_unit="min"), names=by_number),
        "no header, stated time": _text(_headerless(table(SECONDS, cells(), separator="\t")), stated=FileFormat(time="1", header=False), names=by_number, suffix=".txt"),
        "a stated header of numbers": _text(table(SECONDS, cells(), ("0.5", "101", "102", "103")), stated=FileFormat(header=True, time="0.5"), names={"qc": "101", "C": "102", "T": "103"}),
        "UTC": _text(table(_iso(START), cells(), STAMPS), start=START),
        "Z and milliseconds": _text(table([time.strftime("%Y-%m-%dT%H:%M:%S.250Z") for time in clock()], cells(), ("timestamp", "qc", "C", "T")), start=START + timedelta(seconds=0.25)),
        "an offset": _text(table(_iso(START, BERLIN), cells(), ("datetime", "qc", "C", "T")), start=START),
        "offsets when summer time begins": _text(table(_iso(WINTER_ENDS, BERLIN), cells(), STAMPS), start=WINTER_ENDS),
        "offsets when summer time ends": _text(table(_iso(SUMMER_ENDS, BERLIN), cells(), STAMPS), start=SUMMER_ENDS),
        "local time when summer time begins": _text(table(_stamps("%Y-%m-%d %H:%M:%S", WINTER_ENDS, BERLIN), cells(), STAMPS), stated=FileFormat(zone="Europe/Berlin"), start=WINTER_ENDS),
        "local time when summer time ends": _text(table(_stamps("%Y-%m-%d %H:%M:%S", SUMMER_ENDS, BERLIN), cells(), STAMPS), stated=FileFormat(zone="Europe/Berlin"), start=SUMMER_ENDS),
        "zones by name when summer time ends": _text(table(_stamps("%d.%m.%Y %H:%M %Z", SUMMER_ENDS, BERLIN), cells(), STAMPS), start=SUMMER_ENDS),
        "no zone": _text(table(_stamps("%Y-%m-%d %H:%M:%S"), cells(), ("datetime", "qc", "C", "T"), ";"), start=START),
        "UTC in the header": _text(table(_stamps("%Y-%m-%d %H:%M:%S"), cells(), ("Time [UTC]", "qc", "C", "T")), start=START),
        "a German date": _text(table(german, commas(cells()), STAMPS, ";"), stated=FileFormat(zone="Europe/Berlin"), start=START),
        "two digits of the year": _text(table(_stamps("%d.%m.%y %H:%M"), commas(cells()), STAMPS, ";"), start=START),
        "a date and a time of day": _text(table([time.strftime("%d.%m.%Y;%H:%M:%S") for time in clock()], commas(cells()), ("Datum", "Uhrzeit", "qc", "C", "T"), ";"), start=START),
        "an American date": _text(table(_stamps("%m/%d/%Y %I:%M:%S %p", datetime(2026, 3, 14, 22, 0, tzinfo=UTC)), cells(), STAMPS), start=datetime(2026, 3, 14, 22, 0, tzinfo=UTC)),
        "a British date": _text(table(_stamps("%d/%m/%Y %H:%M:%S", datetime(2026, 3, 4, 22, 0, tzinfo=UTC)), cells(), STAMPS), start=datetime(2026, 3, 4, 22, 0, tzinfo=UTC)),
        "a stated format": _text(table(_stamps("%d/%m/%Y %Hh%M"), cells(), STAMPS), stated=FileFormat(time_format="%d/%m/%Y %Hh%M"), start=START),
        "the month by name": _text(table(_stamps("%d-%b-%y %H:%M:%S"), cells(), ("Timestamp", "qc", "C", "T")), start=START),
        "Unix seconds": _text(table([f"{item}.0" for item in unix], cells(), ("ts", "qc", "C", "T")), start=START),
        "Unix milliseconds": _text(table([f"{item}000" for item in unix], cells(), ("timestamp", "qc", "C", "T")), start=START),
        "days of a spreadsheet": _text(table([f"{46082 + (8 * 60 + row) / 1440:.10f}" for row in range(ROWS)], cells(), ("Date", "qc", "C", "T"), ";"), start=START),
        "the day of the week": _text(table(_stamps("%a %d.%m.%Y %H:%M"), commas(cells()), STAMPS, ";"), start=START),
        "milliseconds after a comma": _text(table(_stamps("%Y-%m-%d %H:%M:%S,000"), cells(), STAMPS, ";"), start=START),
        "a time of day": _text(table(_stamps("%H:%M:%S"), cells(), ("time", "qc", "C", "T")), first_min=480.0),
        "a time of day over midnight": _text(table(_stamps("%H:%M", START + timedelta(hours=14)), cells(), ("time", "qc", "C", "T")), first_min=1320.0),
        "quoted historian": _text(table([f'"{item}"' for item in _stamps("%d-%b-%y %H:%M:%S")], cells(), ('"Time"', '"qc"', '"C"', '"T"')), start=START),
        "an index": _text(table([f"{row},{60 * row}" for row in range(ROWS)], cells(), ("", "time", "qc", "C", "T"))),
        "names that are numbers": _text(table(SECONDS, cells(), ("time", "101", "102", "103")), names={"qc": "101", "C": "102", "T": "103"}),
        "headers of two lines": _text(table(SECONDS, cells(), ('"Time\n[s]"', '"qc\n[l/min]"', "C", '"T\n[K]"'), ";")),
        "a hint at the separator": _text("sep=;\n" + semicolon),
        "a description below the names": _text(table(SECONDS, cells(), ("Time", "qc", "C", "T"), ";", below=["Timestamp;coolant flow;concentration;temperature", "s;l/min;mol/l;K"])),
        "time since the start": _text(table([f"{row // 60:02d}:{row % 60:02d}:00" for row in range(ROWS)], cells(), ("elapsed", "qc", "C", "T"))),
        "units after a stroke": _text(table(SECONDS, cells(), ("Time / s", "qc / l/min", "C / mol/l", "T / K"), ";")),
        "units in words": _text(table(MINUTES, cells(), ("time in min", "qc in l/min", "C in mol/l", "T in K"))),
        "units in the header": _text(table(MINUTES, cells(), ("time [min]", "qc [l/min]", "C [mol/l]", "T [K]"))),
        "units that differ": _text(table(MINUTES, celsius, ("time_min", "qc (l/min)", "C (mol/l)", "T (degC)"))),
        "units in a row": _text(table(MINUTES, cells(), ("time", "qc", "C", "T"), ";", below=["min;l/min;mol/l;K"])),
        "bracketed units in a row": _text(table(SECONDS, cells(), ("Time", "qc", "C", "T"), "\t", below=["[s]\t[l/min]\t[mol/l]\t[K]"]), suffix=".txt"),
        "other names": _text(table(MINUTES, cells(), ("time_min", "FC-7", "AI-3", "TI-101")), names={"qc": "FC-7", "C": "AI-3", "T": "TI-101"}),
        "more columns, and text": _text(table(MINUTES, [[*row, "ok", "7"] for row in cells()], ("time_min", "qc", "C", "T", "remark", "n2"))),
        "comments": _text(table(MINUTES, cells(), above=["# rig 7", "# 2026-03-01, run 3"])),
        "comments between the rows": _text(plain.replace("\n9,", "\n# valve opened by hand\n9,")),
        "a header in a comment": _text(table(MINUTES, cells(), ("# time_min", "qc", "C", "T"))),
        "percent comments": _text(table(MINUTES, cells(), ("% t [min]", "qc", "C", "T"), "\t", above=["% MATLAB"]), suffix=".txt"),
        "a title": _text(table(MINUTES, cells(), above=["Export of the historian", ""])),
        "empty cells": _text(table(MINUTES, cells("")), has_holes=True),
        "NA": _text(table(MINUTES, cells("NA")), has_holes=True),
        "NaN and semicolons": _text(table(MINUTES, commas(cells("NaN")), separator=";"), has_holes=True),
        "Bad Input": _text(table(MINUTES, cells("Bad Input")), has_holes=True),
        "a sentinel": _text(table(MINUTES, cells("-999.0")), stated=FileFormat(missing=("-999",)), has_holes=True),
        "a sentinel and a decimal comma": _text(table(MINUTES, commas(cells("-9999.00")), separator=";"), stated=FileFormat(missing=("-9999",)), has_holes=True),
        "a word of its own": _text(table(MINUTES, cells("defekt")), stated=FileFormat(missing=("defekt",)), has_holes=True),
        "rows and columns exchanged": _text(_transposed(plain, ",")),
        "exchanged, with units": _text(_transposed(table(MINUTES, cells(), ("time", "qc", "C", "T"), ";", below=["min;l/min;mol/l;K"]), ";")),
        "exchanged, without names": _text("\n".join("  ".join(row) for row in zip(*cells(), strict=True)) + "\n", stated=FileFormat(period="60s"), names=only_numbers, suffix=".dat"),
        "long": _text(_long(lambda time: time.isoformat(), "", ("timestamp", "tag", "value"), ",", by_tag=False), has_holes=True, start=START),
        "long, by tag, with qualities": _text(_long(lambda time: time.strftime("%d-%b-%Y %H:%M:%S"), "Bad Input", ("Time", "Tag", "Value", "Quality"), ";", by_tag=True), has_holes=True, start=START),
        "gzip": Variant(gzip.compress(plain.encode(), mtime=0), suffix=".csv.gz"),
        "Windows line ends and a byte order mark": Variant(b"\xef\xbb\xbf" + semicolon.replace("\n", "\r\n").encode()),
        "old Mac line ends": Variant(plain.replace("\n", "\r").encode()),
        "UTF-16 with tabs": Variant(table(MINUTES, cells(), separator="\t").encode("utf-16"), suffix=".txt"),
        "a separator at the end": _text(plain.replace("\n", ",\n")),
        "a separator at the end of the rows": _text("time_min,qc,C,T\n" + _headerless(plain).replace("\n", ",\n")),
        "empty rows at the end": _text(plain + ",,,\n,,,\n"),
        "German Excel": replace(
            Variant(excel.replace("\n", "\r\n").replace("°C", "K").encode("cp1252")), stated=FileFormat(zone="Europe/Berlin"), has_holes=True, start=START, names=kelvin_names
        ),
        "LabVIEW": _text(table([f"{60 * row},0" for row in range(ROWS)], [[*row, ""] for row in commas(cells())], ("X_Value", "qc", "C", "T", "Comment"), "\t", above=LABVIEW), suffix=".lvm"),
        "UTF-16 without a byte order mark": Variant(table(MINUTES, cells(), separator="\t").encode("utf-16-le"), suffix=".txt"),
        "UTF-32": Variant(plain.encode("utf-32")),
        "several separators at the end of the rows": _text("time_min,qc,C,T\n" + _headerless(plain).replace("\n", ",,,\n")),
        "a separator at the end of the header": _text(plain.replace("T\n", "T,\n", 1)),
        "thousands after blanks": _text(table([f"{60000 * row:,}".replace(",", " ") for row in range(ROWS)], commas(cells()), ("t_ms", "qc", "C", "T"), ";")),
        "thousands after narrow blanks": _text(table([f"{60000 * row:,}".replace(",", "\u202f") for row in range(ROWS)], commas(cells()), ("t_ms", "qc", "C", "T"), ";")),
        "thousands after apostrophes": _text(table([f"{60000 * row:,}".replace(",", "'") for row in range(ROWS)], cells(), ("t_ms", "qc", "C", "T"), ";")),
        "thousands in quotes": _text(table([f'"{60000 * row:,}"' for row in range(ROWS)], cells(), ("t_ms", "qc", "C", "T"))),
        "a.m. and p.m.": _text(table([time.replace("AM", "a.m.").replace("PM", "p.m.") for time in _stamps("%Y-%m-%d %I:%M:%S %p")], cells(), STAMPS), start=START),
        "the month in German": _text(table([f"{time.day}. März {time:%Y %H:%M:%S}" for time in clock()], commas(cells()), STAMPS, ";"), start=START),
        "the month in French": _text(table([f"{time.day} déc. {time:%Y %H:%M:%S}" for time in clock(START.replace(month=12))], commas(cells()), STAMPS, ";"), start=START.replace(month=12)),
        "a time as C writes it": _text(table(_stamps("%a %b %d %H:%M:%S %Y"), cells(), STAMPS), start=START),
        "a date without signs": _text(table(_stamps("%Y%m%d %H%M%S"), cells(), STAMPS), start=START),
        "fourteen digits": _text(table(_stamps("%Y%m%d%H%M%S"), cells(), STAMPS), start=START),
        "a date, and a time in twelve hours": _text(table([time.strftime("%Y-%m-%d,%I:%M:%S %p") for time in clock()], cells(), ("Date", "Time", "qc", "C", "T")), start=START),
        "newest row first": _text("time_min,qc,C,T\n" + "\n".join(_headerless(plain).split("\n")[-2::-1]) + "\n"),
        "newest timestamp first": _text("Zeit,qc,C,T\n" + "\n".join(_headerless(table(_iso(START), cells(), STAMPS)).split("\n")[-2::-1]) + "\n", start=START),
        "blank lines between the rows": _text(plain.replace("\n9,", "\n\n \n9,")),
        "a line of text at the end": _text(plain + "\n(240 rows affected)\n"),
        "a header that is repeated": _text(plain.replace("\n9,", "\ntime_min,qc,C,T\n9,")),
        "names that occur twice, beside the signals": _text(table(MINUTES, [[*row, "ok", "ok"] for row in cells()], ("time_min", "qc", "C", "T", "Status", "Status"))),
        "no last line end": _text(plain.rstrip("\n")),
        "blank lines around": _text("\n" + plain + "\n \n"),
        "blanks around the cells": _text(plain.replace(",", " , ")),
        "columns in another order": _text("\n".join(",".join(line.split(",")[::-1]) for line in plain.split("\n"))),
        "quotes": _text("\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in plain.splitlines()) + "\n"),
        "dashes": _text(table(MINUTES, cells("---")), has_holes=True),
        "comma as separator and decimal sign": _text(
            table([f"{row},0" for row in range(ROWS)], commas(cells())), stated=FileFormat(decimal=",")
        ),
    }  # fmt: skip


VARIANTS = _variants()
