"""Jobs give the same results on any executor; a failure stays with its job, and a dead worker costs a retry."""

import multiprocessing
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.runtime.jobs import (
    RETRIES,
    THREADS,
    Executor,
    Failed,
    ProcessExecutor,
    SerialExecutor,
    available_cores,
    choose_executor,
    in_job_order,
)
from tests.cluster import dask_cluster
from tests.running import WITHIN_S
from tests.unit.runtime.work import deadly, endless, linear_algebra_threads, picky, square, unspeakable


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a Dask cluster of two workers on this machine."""
    with dask_cluster(2) as address:
        yield address


@pytest.fixture(scope="module")
def mortal_cluster() -> Iterator[str]:
    """The address of another one, whose workers die: on a busy machine it takes long until others are started."""
    with dask_cluster(2) as address:
        yield address


@pytest.fixture(params=["here", "one process", "two processes", "cluster"])
def anyone(request: pytest.FixtureRequest) -> Executor:
    """Each kind of workers in turn."""
    if request.param == "cluster":
        return choose_executor(None, request.getfixturevalue("cluster"))
    if request.param == "here":
        return SerialExecutor()
    return ProcessExecutor(1 if request.param == "one process" else 2)


@pytest.fixture(params=["two processes", "cluster"])
def elsewhere(request: pytest.FixtureRequest) -> Executor:
    """Each kind of workers that can die without us."""
    if request.param == "cluster":
        return choose_executor(None, request.getfixturevalue("mortal_cluster"))
    return ProcessExecutor(2)


def test_answers_are_those_of_the_function_in_the_order_of_the_jobs(anyone: Executor) -> None:
    assert list(in_job_order(anyone.map_unordered(square, range(12)))) == [number**2 for number in range(12)]


def test_a_job_that_fails_is_reported_in_one_line_and_the_others_are_done(anyone: Executor) -> None:
    first, bad, broken, last = in_job_order(anyone.map_unordered(picky, range(4)))
    assert (first, last) == (0, 3)
    assert bad == Failed("x must not be 1, got 1")
    assert isinstance(broken, Failed)
    assert broken.is_internal
    assert broken.reason.startswith("internal error: ZeroDivisionError: by x - 2 (work.py, line ")


def test_no_jobs_have_no_outcomes(anyone: Executor) -> None:
    assert list(anyone.map_unordered(square, [])) == []


def test_a_worker_that_dies_costs_a_retry(elsewhere: Executor, tmp_path: Path) -> None:
    jobs = [(number, str(tmp_path), int(number == 2)) for number in range(6)]
    assert list(in_job_order(elsewhere.map_unordered(deadly, jobs))) == list(range(6))
    assert (tmp_path / "deaths-2").read_text() == "x"


def test_a_job_that_its_workers_always_die_of_is_given_up_and_the_others_are_done(
    elsewhere: Executor, tmp_path: Path
) -> None:
    jobs = [(number, str(tmp_path), 99 * int(number == 1)) for number in range(6)]
    found = list(in_job_order(elsewhere.map_unordered(deadly, jobs)))
    given_up = found.pop(1)
    assert found == [0, 2, 3, 4, 5]
    assert isinstance(given_up, Failed)
    assert given_up.reason.startswith("given up: ")
    if isinstance(elsewhere, ProcessExecutor):
        assert (tmp_path / "deaths-1").read_text() == "x" * (1 + RETRIES)


def test_a_result_that_cannot_be_sent_is_a_failure(tmp_path: Path) -> None:
    found = list(in_job_order(ProcessExecutor(2).map_unordered(unspeakable, range(3))))
    assert (found[0], found[2]) == (0, 2)
    assert isinstance(found[1], Failed)


def test_each_process_has_one_thread_of_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    assert list(ProcessExecutor(1).map_unordered(linear_algebra_threads, [0])) == [(0, "1")]


def test_a_caller_that_stops_iterating_leaves_no_process_behind() -> None:
    before = set(multiprocessing.active_children())  # of a cluster that other tests have, they come and go
    outcomes = ProcessExecutor(2).map_unordered(square, range(100))
    next(outcomes)
    own = {child for child in set(multiprocessing.active_children()) - before if "Dask" not in child.name}
    assert own
    outcomes.close()
    assert not own & set(multiprocessing.active_children())


def test_outcomes_wait_for_those_before_them() -> None:
    seen = []

    def done() -> Iterator[tuple[int, str]]:
        for number in (2, 0, 3, 1):
            seen.append(number)
            yield number, "abcd"[number]

    order = in_job_order(done())
    assert next(order) == "a"
    assert seen == [2, 0]
    assert [*order] == ["b", "c", "d"]


def test_one_process_is_this_one_and_by_default_there_is_one_a_core() -> None:
    assert isinstance(choose_executor(1), SerialExecutor)
    assert isinstance(choose_executor(2), ProcessExecutor)
    assert isinstance(choose_executor(), SerialExecutor if available_cores() == 1 else ProcessExecutor)


@pytest.mark.parametrize(
    ("processes", "scheduler", "said"),
    [
        (0, None, "--jobs must be at least 1, got 0"),
        (2, "tcp://127.0.0.1:8786", "--jobs is for this machine, and --scheduler for a cluster; give one of them"),
        (None, "here", "--scheduler must be an address like tcp://127.0.0.1:8786, got 'here'"),
    ],
)
def test_an_impossible_setting_is_reported_in_one_line(processes: int | None, scheduler: str | None, said: str) -> None:
    if scheduler == "here":
        pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
    with pytest.raises(InputError) as told:
        choose_executor(processes, scheduler)
    assert str(told.value) == said


def test_without_dask_the_cure_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"^--scheduler needs Dask: pip install 'reactorwatch\[cluster\]'$"):
        choose_executor(None, "tcp://127.0.0.1:8786")


@pytest.mark.parametrize(
    ("theirs", "said"),
    [("0.0.1", "has reactorwatch 0.0.1, this is "), (None, "has no reactorwatch; install ")],
)
def test_workers_with_another_version_or_none_are_reported(
    cluster: str, theirs: str | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reactorwatch.runtime.jobs._version_query", lambda: lambda: theirs)
    with pytest.raises(InputError, match=said):
        list(choose_executor(None, cluster).map_unordered(square, range(2)))


def test_a_cluster_without_workers_is_reported_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reactorwatch.runtime.jobs.WORKERS_WITHIN_S", 0.2)
    with dask_cluster(0) as address:
        said = f"has no workers; start some with: dask worker {address} --nthreads 1"
        with pytest.raises(InputError, match=said):
            list(choose_executor(None, address).map_unordered(square, range(2)))


def test_a_missing_scheduler_is_reported_by_its_address(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
    monkeypatch.setattr("reactorwatch.runtime.jobs.CONNECT_WITHIN_S", 0.2)
    with pytest.raises(InputError, match=r"^--scheduler tcp://127\.0\.0\.1:1: cannot be reached: "):
        list(choose_executor(None, "tcp://127.0.0.1:1").map_unordered(square, range(2)))


def test_a_closed_executor_ends_its_running_job_and_starts_no_other(tmp_path: Path) -> None:
    executor, found = ProcessExecutor(1), list[object]()
    os.mkfifo(tmp_path / "runs")
    jobs = [str(tmp_path / "runs")] * 2
    thread = threading.Thread(target=lambda: found.extend(executor.map_unordered(endless, jobs)))
    thread.start()
    assert (tmp_path / "runs").read_text() == "x"  # waits for the job
    executor.close()
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert found == []
