"""Values that repeat far from all others are named as probably not measured, with the option that excludes them."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import reactorwatch as rw
from reactorwatch.cli.main import app
from reactorwatch.records.cells import describe_sentinels
from reactorwatch.records.read import read_table

CODES = [-99, -999, -9999, -999.9, -99.99, 9999, 99999, 32767, -32768, 65535, -2147483648, 1e10, 1e14, -1e12]


def level(rows: int = 300, seed: int = 1) -> np.ndarray:
    """A measured level, in hundredths of a percent."""
    return (50.0 + np.random.default_rng(seed).normal(size=rows)).round(2)


@settings(max_examples=200)
@given(
    code=st.sampled_from([*CODES, 1234.5, -777]),
    scale=st.floats(0.01, 5.0),
    rows=st.sets(st.integers(0, 299), min_size=3, max_size=150),
)
def test_any_code_in_any_rows_is_named_with_their_number(code: float, scale: float, rows: set[int]) -> None:
    values = level() * scale / 10.0
    values[list(rows)] = code
    (note,) = describe_sentinels({"y": values, "sound": level()})
    assert note.startswith(f"{code:.15g} is probably no measurement but a code, in {len(rows)} rows of y ")
    assert f"--missing {code:.15g} " in note


def test_two_codes_in_two_signals_are_named_each_once() -> None:
    first, second = level(), level(seed=2)
    first[[3, 4]], first[[7, 8, 9]], second[[5, 6]] = -999.0, 9999.0, -999.0
    notes = describe_sentinels({"a": first, "b": second})
    assert [note.partition(" is probably")[0] for note in notes] == ["-999", "9999"]
    assert "2 rows of a, 2 rows of b" in notes[0]


SOUND = {
    "an input that sits at 0": np.where(np.arange(300) % 50 < 20, 0.0, level()),
    "a nearly closed input that sits at 100": np.where(np.arange(300) % 50 < 20, 100.0, level() / 50.0),
    "an input that sits at 99.9": np.where(np.arange(300) % 50 < 20, 99.9, level()),
    "a flow of zero beside a large one": np.where(np.arange(300) < 100, 0.0, 1e4 + level()),
    "a quantised sensor": np.round(level() * 2.0) / 2.0,
    "a level about 999": np.where(np.arange(300) % 7 == 0, 999.0, 999.0 + level() - 50.0),
    "an actuator of two steps": np.where(np.arange(300) % 30 < 15, 20.0, 9999.0),
    "a mode": (np.arange(300) // 100).astype(float),
    "a converter that counts to its limit": np.minimum(np.arange(300.0) * 250.0, 65535.0),
    "a single outlier": np.where(np.arange(300) == 5, -999.0, level()),
    "a step of a set point": np.where(np.arange(300) < 150, 20.0, 60.0),
    "constant": np.full(300, 7.0),
    "nothing": np.full(300, np.nan),
    "a batch that dwells at its end": np.minimum(np.arange(300.0), 250.0),
}


@pytest.mark.parametrize("kind", SOUND)
def test_sound_signals_have_no_code(kind: str) -> None:
    assert describe_sentinels({"u": SOUND[kind]}) == []


FORMS = {
    "comma separated": ("time_min,y\n", "{t},{y}\n", "-999"),
    "one decimal": ("time_min,y\n", "{t},{y:.1f}\n", "-999"),
    "decimal comma": ("time_min;y\n", "{t};{y}\n", "-999"),
    "long": ("time,tag,value\n", "2026-03-01 08:{m:02d}:{s:02d},y,{y}\n", "-999"),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_option_that_a_note_names_excludes_the_code_and_the_note(form: str, tmp_path: Path) -> None:
    header, line, code = FORMS[form]
    values, path = level(), tmp_path / "rows.csv"
    values[20:27] = -999.0
    rows = [line.format(t=row, y=value, m=row // 60, s=row % 60) for row, value in enumerate(values.tolist())]
    path.write_text(header + "".join(row.replace(".", ",") if ";" in row else row for row in rows))
    read = read_table(path)
    assert "-999 is probably no measurement but a code, in 7 rows of y" in read.read_as
    again = rw.read_record(path, rw.Process("rig", (rw.Signal("y"),)), missing=code)
    assert "probably" not in again.read_as
    assert np.nanmin(again.signals["y"]) > 0


@pytest.mark.parametrize("command", ["info", "backtest", "diagnose"])
def test_info_backtest_and_diagnose_name_a_code(command: str, tmp_path: Path) -> None:
    path = tmp_path / "tanks.csv"
    generator = np.random.default_rng(1)
    u = np.repeat(generator.uniform(2.0, 4.0, 100), 4)
    driven = rw.Record(np.arange(400) / 15.0, {"u": u, "x2": np.full(400, 5.0)}, "tanks")
    x2 = rw.simulate(driven).signals["x2"] + 0.02 * generator.normal(size=400)
    x2[[50, 51, 52, 53]] = -999.0
    rows = zip(driven.time_min.tolist(), u.tolist(), x2.tolist(), strict=True)
    path.write_text("time_min,u,x2\n" + "".join(f"{t!r},{a!r},{b!r}\n" for t, a, b in rows))
    for form in ([], ["--json"]):
        result = CliRunner().invoke(app, [command, str(path), "--process", "tanks", *form])
        shown = " ".join(f"{result.stderr} {result.output} {result.exception}".split())
        assert "-999" in shown, (command, form, shown)
        assert "--missing -999" in shown, (command, form, shown)
        if form and result.exit_code == 0:
            json.loads(result.stdout)
