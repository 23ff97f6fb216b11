"""Folders, patterns and many files: `backtest` and `diagnose` in several processes and on a cluster."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.records.write import write_table
from recorder.tools.convert import import_csv
from tests.cluster import dask_cluster

from .conftest import PATIENCE_S, REACTORWATCH, Command

FILES, MORE_FILES = 3, 8

HEARS_CTRL_C = (
    "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
)
"""Where tests run behind a shell's `&` or `nohup`, what they start ignores it."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three short records, one with a leak in it, and one that is malformed."""
    folder = tmp_path_factory.mktemp("many")
    for number in range(FILES):
        faults = ("coolant_flow:step:-0.2@20min",) if number == 1 else ()
        write_table(folder / f"run-{number}.csv", simulate_record(PlantConfig(seed=30 + number, faults=faults), 400))
    (folder / "run-2b.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n0.1,100,x,440\n")
    return folder


@pytest.fixture
def cluster() -> Iterator[str]:
    """The address of a Dask cluster on this machine; `test_jobs.py` has one of two workers."""
    with dask_cluster(1) as address:
        yield address


def objects(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    """What was printed, without what differs from run to run."""
    return [
        {name: value for name, value in json.loads(line).items() if name != "seconds"}
        for line in done.stdout.splitlines()
    ]


MALFORMED = (
    "reactorwatch: run-2b.csv: row 3, column 'C': expected a finite number or nothing, got 'x'; "
    "--missing x reads it as not measured"
)


@pytest.mark.slow
def test_a_diagnosis_is_the_same_in_one_process_in_two_and_on_a_cluster(
    folder: Path, called: Command, command: Command, cluster: str
) -> None:
    everywhere = ((called, "--jobs", "1"), (command, "--jobs", "2"), (called, "--scheduler", cluster))
    ended = [run("diagnose", "run-*.csv", "--json", *by, cwd=folder) for run, *by in everywhere]
    for done in ended:
        assert done.returncode == 2
        assert done.stderr.splitlines() == [MALFORMED]
    alone, *others = map(objects, ended)
    assert [item["file"] for item in alone] == [f"run-{number}.csv" for number in range(FILES)]
    assert [item["verdict"] for item in alone].count("named") == 1
    assert others == [alone, alone]


def test_a_folder_stands_for_the_records_in_it_and_a_summary_lists_the_result_of_each(
    folder: Path, called: Command, tmp_path: Path
) -> None:
    options = ("--training", "15", "--jobs", "1", "-o", tmp_path / "out")
    done = called("backtest", folder, *options)
    assert done.returncode == 2
    names = [f"run-{number}" for number in (0, 1, 2, "2b")]
    with (tmp_path / "out" / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == [str(folder / f"{name}.csv") for name in names]
    assert [bool(row["error"]) for row in rows] == [name == "run-2b" for name in names]
    assert int(rows[1]["alarms"]) > 0
    assert float(rows[1]["first_alarm_min"]) >= 20.0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["failed"] == 1
    assert done.stdout.splitlines()[-1].startswith("4 files: ")
    assert done.stdout.splitlines()[-1].endswith(", 1 failed")


def test_imported_recordings_of_a_folder_are_one_each(folder: Path, called: Command, tmp_path: Path) -> None:
    for number in range(2):
        import_csv(folder / f"run-{number}.csv", tmp_path / f"{number}.mcap", "cstr")
    done = called("backtest", tmp_path, "--training", "15", "--jobs", "1", "--json")
    assert done.returncode == 0, done.stderr
    assert [item["file"] for item in objects(done)] == [str(tmp_path / f"{number}.mcap") for number in range(2)]


def test_impossible_options_are_reported_once_and_not_for_each_file(folder: Path, called: Command) -> None:
    for options in (("--tolerance", "pH=1"), ("--limits", "p=1..2"), ("--uncertain", "K9=2%"), ("--model", "no.json")):
        done = called("diagnose", "run-*.csv", "-o", "nothing", *options, cwd=folder)
        assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1), options
        assert not (folder / "nothing").exists()


@pytest.mark.slow
def test_a_process_that_is_killed_meanwhile_costs_no_result(folder: Path, tmp_path: Path) -> None:
    for number in range(MORE_FILES):  # more than is done before we look
        shutil.copy(folder / "run-0.csv", tmp_path / f"run-{number:02}.csv")
    arguments = [REACTORWATCH, "diagnose", "run-*.csv", "--json", "--jobs", "2"]
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        first = running.stdout.readline()
        os.kill(workers_of(running.pid)[0], signal.SIGKILL)
        rest = running.stdout.read()  # and not by communicate, which forgets what was read ahead of the first line
        complaints = running.stderr.read()
    assert (running.returncode, complaints) == (0, "")
    said = [json.loads(line) for line in (first + rest).splitlines()]
    assert [item["file"] for item in said] == [f"run-{number:02}.csv" for number in range(MORE_FILES)]


def test_ctrl_c_ends_all_processes_and_prints_nothing(folder: Path, tmp_path: Path) -> None:
    for number in range(500):  # more than is done before we look
        shutil.copy(folder / "run-0.csv", tmp_path / f"run-{number:03}.csv")
    arguments = [REACTORWATCH, "diagnose", "run-*.csv", "--json", "--jobs", "2"]
    with subprocess.Popen(
        [sys.executable, "-c", HEARS_CTRL_C, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        start_new_session=True,
    ) as running:
        assert running.stdout is not None
        running.stdout.readline()
        workers = workers_of(running.pid)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does: to all of them
        _, complaints = running.communicate(timeout=PATIENCE_S)
    assert (running.returncode, complaints) == (130, "")
    assert not [number for number in workers if Path(f"/proc/{number}").exists()]


def workers_of(number: int) -> list[int]:
    """The processes that do the work of another."""
    children = map(int, Path(f"/proc/{number}/task/{number}/children").read_text().split())
    return [child for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.slow
def test_a_back_test_by_two_processes_equals_that_of_the_file_alone_and_the_terminal_shows_progress(
    folder: Path, called: Command
) -> None:
    terminal, theirs = os.openpty()
    shown = bytearray()

    def show() -> None:
        with suppress(OSError):  # what a terminal's end reads as
            while text := os.read(terminal, 65536):
                shown.extend(text)

    screen = threading.Thread(target=show)
    screen.start()
    try:
        arguments = [REACTORWATCH, "backtest", "run-0.csv", "run-1.csv", "--training", "15", "--json", "--jobs", "2"]
        among = subprocess.run(
            arguments, stdout=subprocess.PIPE, stderr=theirs, text=True, check=False, cwd=folder, timeout=PATIENCE_S
        )
    finally:
        os.close(theirs)
        screen.join()
        os.close(terminal)
    (said,) = objects(called("backtest", "run-1.csv", "--training", "15", "--json", cwd=folder))
    first, second = objects(among)
    assert (first["file"], second) == ("run-0.csv", {"file": "run-1.csv", **said})
    assert said["alarms"]
    assert b"watching" in shown
