"""A process is found by its name or in a file; an error in a file is reported with its path."""

import json
from pathlib import Path
from textwrap import dedent

import pytest

from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError

EXCHANGER = """
    name = "exchanger"
    missing = [-999, "Bad Input"]
    [time]
    column = "ts"
    unit = "s"
    zone = "Europe/Berlin"
    [[signals]]
    name = "q"
    role = "input"
    unit = "l/s"
    [[signals]]
    name = "th"
    role = "output"
    unit = "degC"
    column = 3
    resolution = 0.01
    bounds = [0, 100]
    [file]
    header = false
    separator = ";"
    decimal = ","
"""
TANKS = """
    name = "rig"
    equations = "three_tanks"
    [parameters]
    A = {value = 160.0, sd = 2.0, unit = "cm2"}
""" + "".join(
    f'\n    [[signals]]\n    name = "{name}"\n    role = "{role}"\n    unit = "{unit}"'
    for name, role, unit in (
        ("Q1", "input", "l/min"),
        ("Q2", "input", "cm3/s"),
        ("h1", "output", "mm"),
        ("h2", "output", "cm"),
        ("h3", "output", "cm"),
    )
)


def write(folder: Path, text: str, name: str = "process.toml") -> Path:
    path = folder / name
    path.write_text(dedent(text), encoding="utf-8")
    return path


def test_a_file_describes_signals_times_and_cells(tmp_path: Path) -> None:
    process = find_process(write(tmp_path, EXCHANGER))
    assert process.name == "exchanger"
    q, th = process.signals
    assert (q.name, q.role, q.unit, q.column) == ("q", "input", "l/s", None)
    assert (th.column, th.resolution, th.bounds) == (3, 0.01, (0.0, 100.0))
    stated = process.file_format
    assert (stated.time, stated.time_unit, stated.zone) == ("ts", "s", "Europe/Berlin")
    assert (stated.header, stated.separator, stated.decimal, stated.transposed) == (False, ";", ",", None)
    assert stated.missing == ("-999.0", "Bad Input")


def test_a_file_names_equations_of_the_catalogue_and_their_constants(tmp_path: Path) -> None:
    process = find_process(write(tmp_path, TANKS))
    assert process.model is not None
    assert process.model.parameter("A").value == 160.0
    assert process.uncertain == {"A": 2.0}
    assert [effect.name for effect in process.effects][:2] == ["pump1", "pump2"]


def test_a_file_names_an_extended_model_beside_it_as_its_equations(tmp_path: Path) -> None:
    (tmp_path / "report").mkdir()
    text = {"format": "reactorwatch.model.v1", "model": "three_tanks", "effects": ["clog13:step:0.2@10min"]}
    write(tmp_path / "report", json.dumps(text), "extended.json")
    process = find_process(write(tmp_path, TANKS.replace('"three_tanks"', '"report/extended.json"')))
    assert process.model is not None
    assert process.model.parameter("clog13.size").value == 0.2
    assert process.units["Q1"] == "l/min"
    with pytest.raises(InputError, match=r"none\.json: there is no such file"):
        find_process(write(tmp_path, TANKS.replace('"three_tanks"', '"none.json"')))


def test_an_extended_model_is_a_process(tmp_path: Path) -> None:
    text = {"format": "reactorwatch.model.v1", "model": "cstr", "effects": ["coolant_flow:step:-0.05@10min"]}
    process = find_process(write(tmp_path, json.dumps(text), "extended.json"))
    assert process.inputs == ("qc",)
    assert process.model is not None
    assert "coolant_flow.size" in process.model.parameter_names


def test_a_python_file_is_run_because_it_was_named(tmp_path: Path) -> None:
    code = """
        from reactorwatch.description.process import Process, Signal

        def process():
            return Process("own", (Signal("y"),))
    """
    assert find_process(write(tmp_path, code, "own.py")).outputs == ("y",)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("def process(): return 3", r"process\(\): must return a reactorwatch Process, got int"),
        ("x = 1", r"^process file .*: it must have a function process\(\) that returns a Process"),
        ("def process(): return 1 / 0", "ZeroDivisionError: division by zero"),
        ("def process(:", "SyntaxError"),
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
    ],
)
def test_a_python_file_that_gives_no_process_is_refused_with_its_path(tmp_path: Path, code: str, text: str) -> None:
    path = write(tmp_path, code, "own.py")
    with pytest.raises(InputError, match=text) as refused:
        find_process(path)
    assert str(refused.value).startswith(f"process file {path}: ")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('role = "input"', 'role = "inptu"', "signal 'q': role must be one of input"),
        ('role = "input"', 'rolle = "input"', r"signal 'q': unknown key 'rolle'; did you mean 'role'\?"),
        ('role = "input"', "", "signal 'q': .*missing required field `role`"),
        ('role = "output"', 'role = "label"', "at least one signal must be an output"),
        ("column = 3", 'column = "q"', "a column of its own, got 'q'"),
        ("column = 3", "column = 0", "Expected `int` >= 1"),
        ("column = 3", "column = 1.5", "got `float`"),
        ("bounds = [0, 100]", "bounds = [100, 0]", "bounds must be a lower and a higher number"),
        ("bounds = [0, 100]", "bounds = [0]", "bounds"),
        ("resolution = 0.01", "resolution = -1", "resolution must be a positive number"),
        ('zone = "Europe/Berlin"', 'zone = "Berlin"', r"\[time\] zone must be a time zone such as Europe/Berlin"),
        ('zone = "Europe/Berlin"', 'zone = "../etc"', r"\[time\] zone must be a time zone"),
        ('zone = "Europe/Berlin"', 'period = "4 s"', "a column or a period"),
        ('unit = "s"', 'unit = "sec"', r"unknown \[time\] unit 'sec'"),
        ('column = "ts"', 'period = "4"', r"\[time\] period must be a positive number with its unit"),
        ('decimal = ","', 'decimal = ";"', r"\[file\] decimal must be"),
        ('separator = ";"', 'separator = ","', r"\[file\] separator and \[file\] decimal must differ"),
        ('separator = ";"', 'separator = "::"', r"\[file\] separator must be one character"),
        ('name = "exchanger"', 'name = "exchanger"\n    generic = true', "generic ones too, need equations"),
        ('name = "exchanger"', "", "missing required field `name`"),
        ('name = "exchanger"', 'name = "exchanger"\n    equations = "three_tank"', r"did you mean 'three_tanks'\?"),
        ('name = "exchanger"', 'name = "exchanger"\n    equations = "tanks"', "need the input 'u'"),
        ('name = "exchanger"', 'name = "x"\n    [parameters]\n    k = {value = 1.0}', "parameters"),
        ('name = "exchanger"', 'name = "exchanger', "is not TOML"),
    ],
)
def test_anything_wrong_in_a_file_is_one_line_with_its_path(tmp_path: Path, old: str, new: str, text: str) -> None:
    assert old in EXCHANGER
    path = write(tmp_path, EXCHANGER.replace(old, new, 1))
    with pytest.raises(InputError, match=text) as refused:
        find_process(path)
    assert str(refused.value).startswith(f"process file {path}: ")
    assert "\n" not in str(refused.value).partition("is not TOML")[0]


def test_an_unknown_name_is_refused_with_the_valid_ones() -> None:
    with pytest.raises(InputError, match=r"unknown process 'cst'; did you mean 'cstr'\? \(valid: .*three_tanks"):
        find_process("cst")


def test_a_file_that_is_not_there_is_refused_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        find_process(tmp_path / "none.toml")


def test_a_file_may_ask_for_the_generic_effects_beside_those_of_its_equations(tmp_path: Path) -> None:
    own = find_process(write(tmp_path, TANKS)).causes
    both = find_process(write(tmp_path, TANKS.replace("equations", "generic = true\n    equations", 1))).causes
    assert both[: len(own)] == own
    assert {"h1.lag", "g.deviation", "h3.source"} <= {effect.name for effect in both[len(own) :]}
