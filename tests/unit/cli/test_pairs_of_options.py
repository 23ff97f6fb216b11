"""Each pair of options of `diagnose`, `backtest`, `identify` and `simulate` ends with an answer or in one line."""

import json
import math
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import EXAMPLES
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.covering import Row, covering_array, pairs_of
from tests.unit.cli.test_crash import run

Shown = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch

ANSWERS, UNUSABLE = (0, 3), 2
"""Exit codes of `docs/breakage.md`: 3 where no file could be watched or diagnosed."""

MOST_ROWS = 45
PERIOD_MIN = 0.1

RIG = """
name = "rig"
equations = "cascaded_tanks"
[parameters]
k1 = {value = 3.0, sd = 0.05}
[[signals]]
name = "u"
role = "input"
unit = "V"
[[signals]]
name = "x2"
role = "output"
unit = "V"
resolution = 0.01
"""
BARE = """
name = "bare"
[[signals]]
name = "u"
role = "input"
[[signals]]
name = "x2"
role = "output"
unit = "V"
bounds = [-5.0, 50.0]
"""
"""A process without equations."""

PLANTS = {
    "cstr": {"process": "", "input": "qc", "output": "T", "parameter": "K3", "cause": "coolant_flow"},
    "boiling": {"process": "", "input": "qc", "output": "C", "parameter": "K3", "cause": "heat_transfer"},
    "three": {
        "process": "--process three_tanks",
        "input": "Q1",
        "output": "h1",
        "parameter": "a1",
        "cause": "leak1",
    },
    "rig": {"process": "--process rig.toml", "input": "u", "output": "x2", "parameter": "k2", "cause": "upper_leak"},
    "bare": {"process": "--process bare.toml", "input": "u", "output": "x2", "parameter": "k2", "cause": "x2.bias"},
}
"""Plants, and what the placeholders of the options stand for."""

FILES = {
    "csv": "{plant}.csv",
    "gz": "{plant}.csv.gz",
    "parquet": "{plant}.parquet",
    "two": "{plant}.csv {plant}_later.csv",
    "runs": "{plant}_runs.csv",
    "gaps": "{plant}_gaps.csv",
}

COMMON = {
    "json": ["", "--json"],
    "column": ["", "--column {output}={output}"],
    "missing": ["", "--missing -999"],
}

DIAGNOSE = {
    "plant": ["cstr", "boiling", "three", "rig"],
    "files": list(FILES),
    "out": ["", "-o report", "-o report --force"],
    "uncertain": ["", "--uncertain {parameter}=2%", "--uncertain {parameter}=0.02%"],
    "tolerance": ["", "--tolerance {output}=0.001", "--tolerance {output}=1000"],
    "limits": ["", "--limits {input}={low}..{high}"],
    "without": ["", "--without {cause}"],
    "jobs": ["", "--jobs 1"],
    **COMMON,
}
BACKTEST = {
    "plant": ["cstr", "boiling", "three", "rig", "bare"],
    "files": list(FILES),
    "training": ["", "--training 20", "--training-rows 150", "--train {plant}.csv"],
    "reference": ["", "--reference equations", "--reference black-box", "--reference arx", "--reference auto"],
    "config": ["", "--config settings.toml"],
    "out": ["", "-o summary", "--rows rows.csv", "--rows rows.csv --force"],
    **COMMON,
}
IDENTIFY = {
    "plant": ["cstr", "three", "rig", "bare"],
    "files": ["csv", "gz", "parquet", "runs", "gaps"],
    "model": ["", *(f"--model {name}" for name in ("oe", "armax", "bj", "narx", "noe"))],
    "order": ["", "--order 1"],
    "delay": ["", "--delay 4", "--delay auto"],
    "validate": ["", "--validate {plant}_later.csv"],
    "settle": ["", "--settle 10"],
    "recursive": [
        "",
        "--recursive",
        "--recursive --forgetting 0.99",
    ],
    "compare": ["", "--compare"],
    "output": ["", "--output {output}"],
    **COMMON,
}
SIMULATE = {
    "plant": ["cstr", "boiling", "three", "rig"],
    "files": ["csv", "gz", "parquet", "runs", "gaps"],
    "fault": [
        "",
        "--fault {cause}:step:{size}@10min",
        "--fault {cause}:ramp:{size}@5min,end=20min",
        "--fault {cause}:constant:{size} --fault {output}.bias:step:0.1@3min",
        "--fault {output}.delay:constant:1",
        "--fault {output}.stuck:step:1@8min",
    ],
    "settle": ["", "--settle 10", "--settle 100000"],
    "out": ["-o new.csv", "-o new.xlsx", "-o new.parquet", "-o new.csv.gz", "-o new.csv --force"],
    **COMMON,
}
COMMANDS = {"diagnose": DIAGNOSE, "backtest": BACKTEST, "identify": IDENTIFY, "simulate": SIMULATE}
SIZES = {"cstr": -0.05, "boiling": -0.05, "three": 0.1, "rig": 0.01, "bare": 0.1}


def records() -> dict[str, Record]:
    """A record of each plant; noise included, with a fault in the second half but for the boiling reactor."""
    boil = EXAMPLES["unknown"].with_law
    assert boil is not None
    plants = {
        "cstr": (cstr(), (90.0, 111.0), [0.1, 438.54], (0.002, 0.3)),
        "boiling": (boil(cstr()), (90.0, 111.0), [0.1, 438.54], (0.002, 0.3)),
        "three": (three_tanks(), (15.0, 45.0), [40.0, 20.0, 30.0], (0.05, 0.05, 0.05)),
        "rig": (tanks(), (1.0, 4.0), [3.0, 3.0], (0.02,)),
    }
    result = {}
    for name, (model, (low, high), start, sds) in plants.items():
        random, rows = np.random.default_rng(5), 400
        hold = 10 if model.name == "cstr" else 20
        time_min = PERIOD_MIN * np.arange(rows, dtype=np.float64)
        inputs = np.repeat(random.uniform(low, high, (rows // hold, len(model.inputs))), hold, axis=0)
        real = inputs.copy()
        if name != "boiling":
            real[rows // 2 :, 0] *= 0.9
        outputs = Simulator(model).run(time_min, real, np.array(start)).outputs
        outputs += np.array(sds) * random.standard_normal(outputs.shape)
        columns = dict(zip(model.input_names, inputs.T, strict=True))
        columns |= dict(zip(model.output_names, outputs.T, strict=True))
        result[name] = Record(time_min, columns, name)
    result["rig"] = replace(result["rig"], columns={n: np.round(c, 2) for n, c in result["rig"].columns.items()})
    result["bare"] = result["rig"]
    return result


@pytest.fixture(scope="module")
def plants(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Record]]:
    """A folder with records of every plant in every form, and the records."""
    folder, made = tmp_path_factory.mktemp("plants"), records()
    for name, record in made.items():
        for ending in (".csv", ".csv.gz", ".parquet"):
            write_table(folder / f"{name}{ending}", record)
        write_table(folder / f"{name}_later.csv", replace(record, time_min=record.time_min + 100.0))
        gaps = {signal: values.copy() for signal, values in record.columns.items()}
        gaps[list(gaps)[-1]][50:60] = np.nan
        keep = np.r_[0:250, 280:400]
        write_table(
            folder / f"{name}_gaps.csv",
            Record(record.time_min[keep], {signal: values[keep] for signal, values in gaps.items()}, name),
        )
        lines = (folder / f"{name}.csv").read_text().splitlines()
        (folder / f"{name}_runs.csv").write_text("\n".join([*lines, *lines[1:201]]) + "\n")
    (folder / "rig.toml").write_text(RIG)
    (folder / "bare.toml").write_text(BARE)
    (folder / "settings.toml").write_text('[monitor]\nfalse_alarms_per_30_days = 5.0\ncharts = ["ewma", "cusum"]\n')
    return folder, made


def command_line(command: str, row: Row, record: Record) -> str:
    """The command line of a combination, with its placeholders filled."""
    plant = row["plant"]
    facts = PLANTS[plant]
    levels = record.columns[facts["input"]]
    parts = [command, FILES[row["files"]], facts["process"]]
    parts += [value for name, value in row.items() if name not in ("plant", "files")]
    names = {**facts, "plant": plant, "size": f"{SIZES[plant]}"}
    names |= {"low": f"{0.9 * levels.min():.4g}", "high": f"{1.1 * levels.max():.4g}"}
    return " ".join(filter(None, parts)).format(**names)


def check_end(code: object, out: str, err: str, typed: str, folder: Path, n_files: int = 1) -> None:
    """Check that a command ended with an answer, or with the reason in one line a file."""
    assert "Traceback" not in out + err, typed
    assert not list((folder / "reports").iterdir()), f"{typed}: {err}"
    assert code in (*ANSWERS, UNUSABLE), f"{typed}: {code}: {err}"
    if code == UNUSABLE:
        reasons = [line for line in err.splitlines() if line.startswith("reactorwatch: ")]
        assert 1 <= len(reasons) <= n_files, f"{typed}: {err}"
    elif "--json" in typed:
        assert out.strip(), typed
        for line in out.splitlines():
            assert isinstance(json.loads(line, parse_constant=lambda _: pytest.fail(typed)), dict), typed


ROWS = [(command, row) for command, options in COMMANDS.items() for row in covering_array(options)]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_pair_of_values_is_in_the_array(command: str) -> None:
    options = COMMANDS[command]
    rows = [row for name, row in ROWS if name == command]
    wanted = {((a, x), (b, y)) for a, b in combinations(options, 2) for x, y in product(options[a], options[b])}
    assert set().union(*(pairs_of(row, options) for row in rows)) == wanted
    least = math.prod(sorted(map(len, options.values()))[-2:])
    assert least <= len(rows) <= MOST_ROWS


@pytest.fixture
def folder(plants: tuple[Path, Mapping[str, Record]], tmp_path: Path, monkeypatch: Patch) -> Path:
    """A folder to be in, with links to all files; crash reports would be in `reports` in it."""
    for file in plants[0].iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "reports").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "reports"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "row"), ROWS, ids=[f"{command}-{number}" for number, (command, _) in enumerate(ROWS)]
)
def test_a_pair_of_options_ends_with_an_answer_or_in_one_line(
    command: str,
    row: Row,
    plants: tuple[Path, Mapping[str, Record]],
    folder: Path,
    monkeypatch: Patch,
    capfd: Shown,
) -> None:
    typed = command_line(command, row, plants[1][row["plant"]])
    code = run(shlex.split(typed), monkeypatch)
    check_end(code, *capfd.readouterr(), typed, folder, len(FILES[row["files"]].split()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "plant"), [(command, plant) for command, options in COMMANDS.items() for plant in options["plant"]]
)
def test_without_options_each_plant_gives_an_answer(
    command: str,
    plant: str,
    plants: tuple[Path, Mapping[str, Record]],
    folder: Path,
    monkeypatch: Patch,
    capfd: Shown,
) -> None:
    """So that the errors of the array are those of its options; a training has to leave rows to judge."""
    needed = {"simulate": {"out": "-o new.csv"}, "backtest": {"training": "--training-rows 200"}}
    row = {"plant": plant, "files": "csv"} | needed.get(command, {})
    typed = command_line(command, row, plants[1][plant])
    assert run(shlex.split(typed), monkeypatch) == 0, capfd.readouterr().err
    assert not list((folder / "reports").iterdir())


WRONG: Sequence[str] = (
    "simulate bare.csv --process bare.toml -o new.csv",
    "backtest cstr.csv --train cstr.csv --training 10",
    "backtest cstr.csv --reference kalman",
    "identify cstr.csv --compare --settle 3",
    "identify cstr.csv --model narx --recursive",
    "identify cstr.csv --order 0",
    "simulate cstr.csv -o new.csv --fault coolant_flow:step:-2@5min",
)


@pytest.mark.parametrize("typed", WRONG)
def test_options_that_exclude_each_other_are_refused_in_one_line(
    typed: str, folder: Path, monkeypatch: Patch, capfd: Shown
) -> None:
    assert run(shlex.split(typed), monkeypatch) == UNUSABLE
    out, err = capfd.readouterr()
    check_end(UNUSABLE, out, err, typed, folder)
