"""What README, CONTRIBUTING and docs tell people to type does what they say."""

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.records.csv_file import write_csv
from reactorwatch.runtime.config import read_settings, section
from recorder.config import RecorderConfig

from .conftest import Command

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]

README = (ROOT / "README.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")

RUN_BLOCKS = re.findall(r"<!-- run.*?-->\n```console\n(.*?)```", README, re.DOTALL)
COMMAND_LINES = re.findall(r"^\$ (.*)$", README, re.MULTILINE)
EXAMPLES = re.findall(r"^## (.*?)$(?:(?!^## ).)*?```python\n(.*?)```", CONTRIBUTING, re.MULTILINE | re.DOTALL)


def test_the_readme_s_commands_on_a_record_work_as_they_stand(tmp_path: Path, command: Command) -> None:
    config = PlantConfig(seed=3, faults=("coolant_flow:step:-0.15@120min",))
    write_csv(tmp_path / "record.csv", simulate_record(config, 1500))
    lines = [line.removeprefix("$ ") for block in RUN_BLOCKS for line in block.splitlines()]
    assert len(lines) == 12
    said = []
    for line in lines:
        name, *arguments = shlex.split(line)
        assert name == "reactorwatch"
        done = command(*arguments, cwd=tmp_path)
        assert done.returncode == 0, f"{line}: {done.stderr}"
        said.append(done.stdout)
    assert "shewhart/T" in said[0]
    first, again = (np.genfromtxt(tmp_path / name, delimiter=",", names=True) for name in ("record.csv", "again.csv"))
    assert np.array_equal(first, again)
    assert (tmp_path / "record.rrd").stat().st_size > 0
    diagnosed = said[[line.split()[1] for line in lines].index("diagnose")]
    assert "The simulation is wrong: coolant leak, since 1" in diagnosed


def test_the_readme_s_make_commands_are_targets_that_set_up_by_themselves() -> None:
    made = [line.split()[1] for line in COMMAND_LINES if line.startswith("make ")]
    assert made == ["demo", "test"]
    for target in made:
        planned = subprocess.run(
            ["make", "--dry-run", "--assume-new=pyproject.toml", target],
            cwd=ROOT, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        assert "venv" in planned
        assert {"demo": "reactorwatch demo", "test": "pytest"}[target] in planned


@pytest.mark.parametrize("line", [line for line in COMMAND_LINES if line.startswith("reactorwatch ")])
def test_every_command_line_of_the_readme_names_a_command_and_options_that_exist(line: str, called: Command) -> None:
    name, *arguments = shlex.split(line)[1:]
    described = called(name, "--help")
    assert described.returncode == 0
    for option in (argument for argument in arguments if argument.startswith("-")):
        assert re.search(rf"(?<![\w-]){re.escape(option)}(?![\w-])", described.stdout), f"{name} has no {option}"


def test_there_is_an_example_of_each_addition() -> None:
    assert [title for title, _ in EXAMPLES] == [
        "Add an effect",
        "Add a chart",
        "Add a message",
        "Add a panel",
        "Add a process model",
    ]


@pytest.mark.parametrize(("title", "code"), EXAMPLES, ids=[title for title, _ in EXAMPLES])
def test_the_example_runs(title: str, code: str) -> None:
    exec(compile(code, f"CONTRIBUTING.md: {title}", "exec"), {"__name__": "example"})


def test_the_example_of_a_diagnosis_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(code, "docs/diagnosis.md", "exec"), {"__name__": "example"})
    assert capsys.readouterr().out.startswith("The simulation is wrong: coolant leak, since ")


def test_the_extended_model_of_the_docs_is_taken() -> None:
    text = (ROOT / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    (written,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    assert parse_extended_model(written).effects[0].effect.name == "coolant_flow"


def test_the_settings_file_of_the_docs_is_taken(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
    (settings,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "settings.toml"
    path.write_text(settings, encoding="utf-8")
    tables = read_settings(path)
    assert section(PlantConfig, "plant", tables, {}).name == "R-101"
    assert section(RecorderConfig, "recorder", tables, {}).plant == "R-101"


@pytest.mark.parametrize("document", DOCUMENTS, ids=[str(path.relative_to(ROOT)) for path in DOCUMENTS])
def test_every_link_within_the_repository_leads_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text(encoding="utf-8")):
        assert (document.parent / target).exists(), target
