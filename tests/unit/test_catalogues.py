"""A chart, a signal check, an effect, a panel is one file and one line, and then works in the running system."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import monitor_node.checks
import reactorwatch.spc.charts
import recorder.panels
from monitor_node.checks.signal_checks import CHECKS
from monitor_node.config import CHART_SIGNALS, MonitorConfig
from monitor_node.watch import row_frame, row_step
from reactorwatch.process import EFFECTS_OF
from reactorwatch.spc.charts.catalogue import CHARTS
from tests.unit.monitor_node.samples import leaking_run

ROOT = Path(__file__).parents[2]

FAMILIES = {
    "charts": (reactorwatch.spc.charts, {chart.__module__ for chart in CHARTS}),
    "checks": (monitor_node.checks, {check.__module__ for check in CHECKS}),
    "panels": (recorder.panels, {panel.draw.__module__ for panel in recorder.panels.PANELS}),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_every_file_of_the_folder_is_listed(family: str) -> None:
    package, listed = FAMILIES[family]
    assert package.__file__ is not None
    files = {path.stem for path in Path(package.__file__).parent.glob("*.py")} - {
        "__init__",
        "base",
        "catalogue",
        "value_chart",
    }
    assert {name.rpartition(".")[2] for name in listed} == files


def test_names_in_a_catalogue_differ() -> None:
    for names in (
        *([effect.name for effect in effects] for effects in EFFECTS_OF.values()),
        [*(kind.name for kind in CHARTS), *(check.name for check in CHECKS)],  # in the names of alarms
        [panel.title for panel in recorder.panels.PANELS],
    ):
        assert len(set(names)) == len(names)


def example(title: str) -> str:
    """The Python of a section of CONTRIBUTING."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    found = re.search(rf"^## {title}$(?:(?!^## ).)*?```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert found, title
    return found[1]


def add(sources: Path, file: str, text: str, catalogue: str, name: str, entry: str, end: str) -> None:
    """Add one file, and one line to a catalogue with its import."""
    (sources / file).write_text(text, encoding="utf-8")
    listed = (sources / catalogue).read_text(encoding="utf-8")
    module = file.removesuffix(".py").replace("/", ".")
    changed = re.sub(rf"(?<=, )(\w+){re.escape(end)}$", rf"\1, {entry}{end}", listed, count=1, flags=re.MULTILINE)
    changed = changed if changed != listed else listed.replace(f"\n{end}\n", f"\n    {entry},\n{end}\n", 1)
    assert changed != listed
    head, first, rest = changed.partition("\nfrom ")
    (sources / catalogue).write_text(f"{head}\nfrom {module} import {name}{first}{rest}", encoding="utf-8")


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages with CONTRIBUTING's chart, signal check and effect in them."""
    folder = tmp_path_factory.mktemp("sources")
    for package in ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node"):
        shutil.copytree(ROOT / package, folder / package)  # with what Numba has compiled
    charts, checks, plants = "reactorwatch/spc/charts", "monitor_node/checks", "reactorwatch/process/library"
    add(
        folder,
        f"{charts}/moving_range.py",
        example("Add a chart"),
        f"{charts}/catalogue.py",
        "MovingRange",
        "MovingRange",
        ")",
    )
    add(
        folder,
        f"{checks}/jump.py",
        example("Add a signal check"),
        f"{checks}/signal_checks.py",
        "JumpCheck",
        "JumpCheck",
        ", RangeCheck)",
    )
    effect = example("Add an effect").partition("\n\n\nfrom ")[0] + "\n"
    add(
        folder,
        f"{plants}/heat_capacity.py",
        effect,
        f"{plants}/cstr.py",
        "HeatCapacity",
        "HeatCapacity()",
        ")\n# fmt: on",
    )
    return folder


def run(sources: Path, *words: str) -> str:
    """What a command of these sources prints."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "reactorwatch", *words],
        env=os.environ | {"PYTHONPATH": str(sources)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_one_file_and_one_line_make_a_chart_and_a_signal_check_that_back_tests_run(
    sources: Path, tmp_path: Path
) -> None:
    """CONTRIBUTING's own, with a setting of the chart's; a step of the sensor raises both."""
    time_min, columns = leaking_run(0.0, 1.0, 60.0, seed=1)
    columns["T"][time_min >= 50.0] += 25.0
    rows = np.column_stack([time_min, columns["qc"], columns["C"], columns["T"]])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="time_min,qc,C,T", comments="", fmt="%.17g")
    settings = 'training_min = 30\ncharts = ["moving_range"]\nmoving_range_factor = 1.1\ndiagnose_training = false\n'
    (tmp_path / "settings.toml").write_text(f"[monitor]\n{settings}", encoding="utf-8")
    told = run(sources, "backtest", str(tmp_path / "run.csv"), "--config", str(tmp_path / "settings.toml"))
    assert "moving_range/T" in told
    assert "jump/T" in told
    assert "T moved by" in told
    assert "jump/C" not in told
    listed = run(sources, "charts", "list")
    assert "moving_range The moving range of two" in listed
    assert "moving_range_factor = 1, in [0.5, 2]" in listed


def test_one_file_and_one_line_make_an_effect_that_is_simulated(sources: Path, tmp_path: Path) -> None:
    """CONTRIBUTING's own: as a fault of `simulate`, it changes the temperature and nothing before its onset."""
    time_min = np.arange(0.0, 60.0, 0.5)
    rows = np.column_stack(
        [time_min, np.full(time_min.size, 103.41), np.full(time_min.size, 0.1), 438.54 + 0 * time_min]
    )
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="time_min,qc,C,T", comments="", fmt="%.17g")
    for name, fault in (("sound", []), ("slower", ["--fault", "heat_capacity:step:0.05@30min"])):
        run(sources, "simulate", str(tmp_path / "run.csv"), *fault, "-o", str(tmp_path / f"{name}.csv"))
    sound, slower = (np.genfromtxt(tmp_path / f"{name}.csv", delimiter=",", names=True) for name in ("sound", "slower"))
    signal = next(name for name in sound.dtype.names or () if name.startswith("T"))
    off = np.abs(slower[signal] - sound[signal])
    assert off[time_min < 30.0].max() < 1e-6
    assert off[time_min > 45.0].max() > 0.1


def test_a_chart_or_check_that_is_not_compiled_for_fleets_leaves_plants_to_the_ordinary_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    signals: dict[str, Any] = {item.key: ("C",) for item in CHART_SIGNALS}
    for kind in CHARTS:
        config = MonitorConfig(charts=(kind.name,), **signals)
        assert row_step.has_step(config) == (kind.name in row_frame.CHARTS)
    monkeypatch.setattr(row_step, "CHECKS", CHECKS[:-1])
    assert not row_step.has_step(MonitorConfig())
