"""A damaged table is read, or refused in one line: no other error, no warning."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.read import SignalColumn, read_table
from tests.unit.records.variants import UNITS, VARIANTS

DAMAGES_OF_A_FILE = 8

JUNK = (
    b"",
    b"x",
    b"1,5",
    b"1e30",
    b"inf",
    b"-1",
    b'"',
    b"NA",
    b"12:00:00",
    b"#",
    b";",
    b",",
    b"\n",
    b"\t",
    b"%",
    b"\r",
    b".",
)
STATED = (
    FileFormat(),
    FileFormat(period="4 s"),
    FileFormat(time="1"),
    FileFormat(header=False),
    FileFormat(header=True),
    FileFormat(transposed=True),
    FileFormat(decimal=","),
    FileFormat(separator=";"),
    FileFormat(zone="Europe/Berlin"),
    FileFormat(time_unit="iso"),
)


def with_junk(text: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(text))
    return text[:start] + rng.choice(JUNK) + text[start + rng.randrange(9) :]


def with_lines_swapped(text: bytes, rng: random.Random) -> bytes:
    lines = text.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)


def with_a_line_twice(text: bytes, rng: random.Random) -> bytes:
    lines = text.split(b"\n")
    lines.insert(rng.randrange(len(lines)), rng.choice(lines))
    return b"\n".join(lines)


def cut(text: bytes, rng: random.Random) -> bytes:
    return b"\n".join(text.split(b"\n")[rng.choice((0, 0, 1, 2, 5)) :][: rng.choice((1, 2, 3, 20, 1000))])


def upside_down(text: bytes, rng: random.Random) -> bytes:
    return b"\n".join(text.split(b"\n")[::-1])


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    with_junk,
    with_lines_swapped,
    with_a_line_twice,
    cut,
    upside_down,
)


def refusal(path: Path, signals: list[SignalColumn] | None, stated: FileFormat) -> str:
    """The line that refuses a file; empty if it is read."""
    try:
        read_table(path, signals, stated)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", VARIANTS)
def test_any_damage_is_read_or_refused_in_one_line(tmp_path: Path, name: str) -> None:
    variant = VARIANTS[name]
    path = tmp_path / f"record{variant.suffix}"
    mapped = [SignalColumn(name, unit, column=variant.names.get(name)) for name, unit in UNITS.items()]
    for seed in range(DAMAGES_OF_A_FILE):
        rng = random.Random(f"{name} {seed}")
        text = variant.content
        for _ in range(rng.choice((1, 1, 2, 4))):
            text = rng.choice(DAMAGES)(text, rng) if text else text
        path.write_bytes(text)
        stated = variant.stated if rng.random() < 0.5 else rng.choice(STATED)
        assert "\n" not in refusal(path, mapped if rng.random() < 0.7 else None, stated)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(b"2,5\n1,x\n0,4\n# time_min,T\n", id="a header in a comment below the rows"),
        pytest.param(b"1.5,839\nExport\nExport\nExport\n2.5,857\n", id="most lines have fewer cells than the first"),
        pytest.param(
            b"Time F L T\n bar l K\n2026-10-25T01:19:30Z 1 2 3\n2026-10-25T02:41:45Z 1 2 Bad Input\n", id="three widths"
        ),
        pytest.param(b"ts,T\n1772352000,1\n1772352001,2\n1772352002,3\ninf,4\n", id="a time without end"),
    ],
)
def test_a_line_out_of_place_is_no_other_error(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "record.csv"
    path.write_bytes(text)
    assert "\n" not in refusal(path, None, FileFormat())
