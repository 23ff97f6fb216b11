"""The command's entry: what it settles before a subcommand runs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from reactorwatch.cli.main import main

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
