"""The decimal sign of a table: decided over all its cells, never a thousandfold."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.layout import HEAD_LINES
from reactorwatch.records.read import read_table

LATE = 6 * HEAD_LINES
"""Rows before the first cell with a sign: many more than those by which the separator and the header are guessed."""

SEPARATORS = {"semicolons": ";", "tabs": "\t", "commas": ",", "strokes": "|"}


def written(value: float, decimals: int, sign: str, *, grouped: bool, stripped: bool) -> str:
    """A number as the programs of a country write it."""
    text = f"{value:,.{decimals}f}" if grouped else f"{value:.{decimals}f}"
    if stripped and decimals:
        text = text.rstrip("0").rstrip(".")
    return text.translate(str.maketrans(".,", sign + ("," if sign == "." else ".")))


def write_wide(path: Path, columns: list[list[str]], separator: str) -> Path:
    rows = [[str(row), *cells] for row, cells in enumerate(zip(*columns, strict=True))]
    cells = [[f'"{cell}"' if separator in cell else cell for cell in row] for row in rows]
    names = ["time_s", *(f"y{number}" for number in range(len(columns)))]
    path.write_text("\n".join(separator.join(row) for row in (names, *cells)) + "\n")
    return path


def write_long(path: Path, columns: list[list[str]], separator: str) -> Path:
    rows = [
        [f"2026-03-01 {row // 3600:02d}:{row // 60 % 60:02d}:{row % 60:02d}", f"y{number}", cell]
        for row, cells in enumerate(zip(*columns, strict=True))
        for number, cell in enumerate(cells)
    ]
    cells = [[f'"{cell}"' if separator in cell else cell for cell in row] for row in rows]
    path.write_text("\n".join(separator.join(row) for row in (["timestamp", "tag", "value"], *cells)) + "\n")
    return path


signals = st.tuples(
    st.floats(0.0, 5.0).map(lambda power: 10.0**power),  # level
    st.sampled_from([1e-4, 0.01, 0.1]),  # noise, as a share of the level
    st.sampled_from([1.0, 1.05, 2.0]),  # step in the middle
    st.sampled_from([0, 0, 1, 2, 3, 3, 3, 5]),  # decimals
    st.booleans(),  # zeros at the end are left out
)


@settings(max_examples=60, deadline=None)
@given(
    signals=st.lists(signals, min_size=1, max_size=3),
    sign=st.sampled_from(".,"),
    grouped=st.booleans(),
    separator=st.sampled_from(list(SEPARATORS.values())),
    is_long=st.booleans(),
    zeros=st.sampled_from([0, HEAD_LINES + 10]),
    seed=st.integers(0, 2**16),
)
@example([(960.0, 1e-3, 1.05, 0, False)], ",", True, ";", False, 0, 1)
@example([(1.1, 0.05, 1.0, 3, False)], ",", False, ";", False, HEAD_LINES + 10, 1)
@example([(1.1, 0.05, 1.0, 3, False)], ".", False, "\t", False, HEAD_LINES + 10, 1)
@example([(300.0, 0.01, 1.0, 0, False), (1.2, 0.01, 1.0, 3, False)], ".", False, ";", True, 0, 1)
def test_a_table_is_read_to_the_numbers_that_were_written_or_refused_with_both_cures(
    tmp_path_factory: pytest.TempPathFactory,
    signals: list[tuple[float, float, float, int, bool]],
    sign: str,
    grouped: bool,
    separator: str,
    is_long: bool,
    zeros: int,
    seed: int,
) -> None:
    assume(not (separator == sign == "," and grouped))  # a table separated by commas has points as decimal signs
    generator, rows = np.random.default_rng(seed), 120
    columns, values = [], []
    for level, noise, step, decimals, stripped in signals:
        course = level * np.where(np.arange(rows) < rows // 2, 1.0, step) * (1.0 + noise * generator.normal(size=rows))
        course = np.concatenate([np.zeros(zeros), np.round(course, decimals)])
        cells = [written(value, decimals, sign, grouped=grouped, stripped=stripped) for value in course.tolist()]
        columns.append(["0"] * zeros + cells[zeros:])
        values.append(course)
    write = write_long if is_long else write_wide
    path = write(tmp_path_factory.mktemp("decimal") / "table.txt", columns, separator)
    try:
        record = read_table(path)
    except InputError as refused:
        line = str(refused)
        record = read_table(path, None, FileFormat(decimal=sign))
    else:
        line = "--decimal . --decimal ,"
    assert "--decimal ." in line
    assert "--decimal ," in line
    for number, expected in enumerate(values):
        np.testing.assert_allclose(record.columns[f"y{number}"], expected, rtol=0, atol=1e-9)


PARTS = {
    "decimals below one": (["0{0}125", "0{0}250"], "."),
    "one and two decimals": (["1{0}5", "12{0}25"], "."),
    "four decimals": (["1{0}2345", "1{0}2500"], "."),
    "three decimals of a thousand": (["1013{0}250", "1013{0}125"], "."),
    "an exponent": (["1{0}234e2", "2{0}345e2"], "."),
    "groups with decimals": (["1{1}013{0}25", "1{1}012{0}75"], "."),
    "millions in groups": (["1{1}234{1}567", "1{1}234{1}568"], "."),
}


@pytest.mark.parametrize("sign", [".", ","], ids=["point", "comma"])
@pytest.mark.parametrize("separator", SEPARATORS.values(), ids=list(SEPARATORS))
@pytest.mark.parametrize("part", PARTS)
def test_one_cell_that_can_only_be_read_one_way_decides_for_all_columns_wherever_it_is(
    tmp_path: Path, sign: str, separator: str, part: str
) -> None:
    """The open column is read as three decimals, and 1,200 rows above the cell that decides change nothing."""
    other = "," if sign == "." else "."
    deciding = [cell.format(sign, other) for cell in PARTS[part][0]]
    columns = [["0"] * LATE + deciding, [f"1{sign}{125 + row % 50:03d}" for row in range(LATE + 2)]]
    record = read_table(write_wide(tmp_path / "table.txt", columns, separator))
    expected = [float(cell.replace(other, "").replace(sign, ".")) for cell in deciding]
    assert record.columns["y0"][LATE:].tolist() == expected
    np.testing.assert_allclose(record.columns["y1"], 1.125 + np.arange(LATE + 2) % 50 / 1000, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("group", "separator"), [*product(".,", [";", "\t"]), (",", ",")])
@pytest.mark.parametrize("is_long", [False, True], ids=["wide", "long"])
def test_integers_that_pass_a_thousand_are_grouped_and_the_guess_is_named(
    tmp_path: Path, group: str, separator: str, is_long: bool
) -> None:
    values = np.concatenate([np.full(LATE, 950), np.arange(955, 1015), np.arange(1015, 955, -1)])
    cells = [f"{value:,}".replace(",", group) for value in values.tolist()]
    columns = [cells, ["0"] * values.size]
    record = read_table((write_long if is_long else write_wide)(tmp_path / "table.txt", columns, separator))
    np.testing.assert_array_equal(record.columns["y0"], values)
    assert f"thousands grouped by `{group}`" in record.read_as


@pytest.mark.parametrize("cells", [["7"], ["0", "963"], ["1013", "1014"], ["0", "-999", "12"]], ids=str)
@pytest.mark.parametrize("separator", SEPARATORS.values(), ids=list(SEPARATORS))
def test_integers_without_a_sign_need_no_statement(tmp_path: Path, cells: list[str], separator: str) -> None:
    path = tmp_path / "table.txt"
    rows = [
        f"{1 + row // 86400:02d}.03.2026 08:{row // 60:02d}:{row % 60:02d}{separator}{cells[row % len(cells)]}"
        for row in range(300)
    ]
    path.write_text("\n".join([f"Zeit{separator}y", *rows]))
    record = read_table(path)
    assert record.columns["y"][: len(cells)].tolist() == [float(cell) for cell in cells]


OPEN = {
    "zeros, then three decimals or thousands": ["0"] * LATE + ["1{0}125", "1{0}130"],
    "only three decimals or thousands": ["101{0}325", "101{0}310"] * 20,
    "an error code below a thousand beside them": ["1{0}125", "1{0}130", "999"] * 20,
    "an error code of four digits beside them": ["1{0}125", "1{0}130", "9999", "963", "962", "961"] * 20,
    "an error code with a minus beside them": ["1{0}125", "1{0}130", "-999", "-998", "-997"] * 20,
    "counts of a few beside them": ["1", "2", "3", "1{0}131", "1{0}132"] * 20,
}


@pytest.mark.parametrize("sign", [".", ","], ids=["point", "comma"])
@pytest.mark.parametrize("separator", [";", "\t"], ids=["semicolons", "tabs"])
@pytest.mark.parametrize("kind", OPEN)
def test_a_table_that_may_be_read_both_ways_is_refused_in_one_line_and_read_as_stated(
    tmp_path: Path, kind: str, separator: str, sign: str
) -> None:
    cells = [cell.format(sign) for cell in OPEN[kind]]
    path = write_wide(tmp_path / "table.txt", [cells], separator)
    row, cell = next((row, cell) for row, cell in enumerate(cells, start=2) if sign in cell)
    name, other = ("point", ",") if sign == "." else ("comma", ".")
    line = (
        f"row {row}: {cell!r} may have a decimal {name} (--decimal {sign}) or group its thousands (--decimal {other})"
    )
    with pytest.raises(InputError) as refused:
        read_table(path)
    assert str(refused.value).startswith(f"{path}, {line}")
    assert "\n" not in str(refused.value)
    decimals, thousands = (read_table(path, None, FileFormat(decimal=stated)).columns["y0"] for stated in (sign, other))
    index = row - 2
    assert thousands[index] == pytest.approx(1000 * decimals[index])


def test_points_in_a_table_separated_by_commas_are_decimal(tmp_path: Path) -> None:
    record = read_table(
        write_wide(tmp_path / "table.csv", [["963", "1.007", "1.010"], ['"1.007"', "2.125", "3.250"]], ",")
    )
    assert record.columns["y0"].tolist() == [963.0, 1.007, 1.01]
    assert record.columns["y1"].tolist() == [1.007, 2.125, 3.25]


def test_rows_of_grouped_numbers_without_names_may_be_signals(tmp_path: Path) -> None:
    """The orientation is found by values, which have groups here."""
    rows = [[f"{level * 1000 + number:,}".replace(",", ".") + ",5" for number in range(12)] for level in (1, 20, 300)]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(";".join(row) for row in rows) + "\n")
    record = read_table(path, None, FileFormat(period="1 s"))
    assert record.columns["2"].tolist() == [20000.5 + number for number in range(12)]
