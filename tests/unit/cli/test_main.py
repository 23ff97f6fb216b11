"""The command's entry: what it settles before a subcommand runs."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from reactorwatch.cli.main import COMMANDS, app, main

THREADS = "OPENBLAS_NUM_THREADS"


@pytest.mark.parametrize(("given", "then"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_more_are_set(
    given: str | None, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS, given or "")
    if given is None:
        monkeypatch.delenv(THREADS)
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ[THREADS] == then


def test_it_is_settled_before_numpy_is_imported() -> None:
    question = "import sys, reactorwatch.cli.main; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", question], check=False).returncode == 0


@pytest.mark.parametrize("node", ["plant_node", "monitor_node", "recorder"])
def test_a_node_starts_without_the_slow_parts_of_scipy_and_without_a_viewer(node: str) -> None:
    slow = {"scipy.signal", "scipy.stats", "scipy.optimize", "sklearn", "rerun", "matplotlib", "pandas"}
    question = f"import sys, {node}.__main__; sys.exit(' '.join({slow!r} & sys.modules.keys()))"
    ended = subprocess.run([sys.executable, "-c", question], capture_output=True, text=True, check=False)
    assert not ended.stderr.strip()


def test_what_does_not_draw_never_imports_rerun() -> None:
    question = (
        "import sys, recorder.node, recorder.tools.replay\n"
        "from reactorwatch.cli.main import main\n"
        "sys.argv = ['reactorwatch', 'record', '--help']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "found = sorted(name for name in sys.modules if name.partition('.')[0].startswith('rerun'))\n"
        "assert not found, found"
    )
    ended = subprocess.run([sys.executable, "-c", question], capture_output=True, text=True, check=False)
    assert "record" in ended.stdout
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_record_is_read_without_pandas_which_takes_long_to_import(tmp_path: Path) -> None:
    (tmp_path / "record.csv").write_text(
        "time_min,qc,C,T\n0,100,0.1,440\n0.1,,0.1,440\n0.2,100,0.1,440\n", encoding="utf-8"
    )
    question = "import sys, reactorwatch as rw; rw.read_record('record.csv'); sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", question], cwd=tmp_path, check=False).returncode == 0


def visible_options() -> Iterator[tuple[str, list[str]]]:
    """Each command that the help lists, with the options that its own help shows."""

    def walk(command: Any, name: str) -> Iterator[tuple[str, list[str]]]:
        if hasattr(command, "commands"):
            for word, inner in command.commands.items():
                if not inner.hidden:
                    yield from walk(inner, f"{name} {word}".strip())
            return
        options = [item for item in command.params if item.param_type_name == "option" and not item.hidden]
        yield name, [item.opts[-1] for item in options if not item.opts[-1].startswith("--help")]

    return walk(typer.main.get_command(app), "")


def test_commands_and_options_are_few_enough_to_be_known() -> None:
    options = dict(visible_options())
    assert len(options) <= 46
    assert max(map(len, options.values())) <= 12, max(options.items(), key=lambda item: len(item[1]))
    assert sum(map(len, options.values())) <= 200


def test_the_help_lists_each_command_under_one_person() -> None:
    by_person = [name for group in COMMANDS.values() for name in group]
    assert sorted(by_person) == sorted({name.split()[0] for name, _ in visible_options()})


@pytest.mark.parametrize(
    ("typed", "there", "absent"),
    [
        ("backtest --help", "--help-file", "--separator"),
        ("backtest --help-file", "--separator", "--training"),
        ("backtest --help-bus", "--config", "--separator"),
        ("alarm acknowledge --help-bus", "--timeout", "--incident"),
    ],
)
def test_each_group_of_options_has_a_help_of_its_own(
    typed: str, there: str, absent: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *typed.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr().out
    assert (ended.value.code, there in shown, absent in shown) == (0, True, False)
