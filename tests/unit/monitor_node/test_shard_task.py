"""The task of a shard, which runs in the event loops of a Dask cluster: its imports, its result, its end."""

import asyncio
import subprocess
import sys

import pytest

from monitor_node.shard_task import end_shards, run_shard
from reactorwatch.errors import InputError
from reactorwatch.version import version


def test_scheduler_and_workers_import_nothing_that_stops_their_event_loops_for_seconds() -> None:
    slow = {"numpy", "scipy", "numba", "casadi", "zenoh", "msgspec", "structlog", "google.protobuf"}
    question = f"import sys, monitor_node.shard_task; sys.exit(' '.join({slow!r} & sys.modules.keys()))"
    ended = subprocess.run([sys.executable, "-c", question], capture_output=True, text=True, check=False)
    assert not ended.stderr.strip()


def test_a_worker_with_another_version_refuses_the_shard_and_names_both() -> None:
    with pytest.raises(InputError, match=rf"the worker has reactorwatch {version()}, the command 0\.1; install the"):
        asyncio.run(run_shard("a", (), "", "0.1"))


def test_the_result_has_the_exit_code_and_the_last_line() -> None:
    code = "import sys; print(open(sys.argv[1]).read(), 'ended', file=sys.stderr); sys.exit(3)"
    ended = asyncio.run(run_shard("a", ("-c", code, "{settings}"), "settings\nof it", version()))
    assert ended == (3, "of it ended")


def test_a_full_disk_under_the_log_of_the_worker_ends_no_shard(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.write", full)
    code = "import sys; print('last', file=sys.stderr, flush=True); sys.exit(4)"
    ended = asyncio.run(run_shard("a", ("-c", code), "", version()))
    assert ended == (4, "last")


WAITS_FOR_ITS_PIPE = ("-c", "import sys; print('up', file=sys.stderr, flush=True); sys.stdin.read()")


def test_shards_are_ended_by_the_beginning_of_their_keys_but_for_those_to_keep() -> None:
    async def run() -> list[bool]:
        keys = ("monitor a/* 1/2 x", "monitor a/* 1/2 y", "monitor b/* 1/2 x")
        tasks = [asyncio.create_task(run_shard(key, WAITS_FOR_ITS_PIPE, "", version())) for key in keys]
        await asyncio.sleep(0)  # they have begun, and no process has started
        await end_shards("monitor a/* ", [keys[1]])
        await tasks[0]
        done = [task.done() for task in tasks]
        for task in tasks[1:]:
            task.cancel()  # as when the worker closes
        await asyncio.gather(*tasks, return_exceptions=True)
        return done

    assert asyncio.run(run()) == [True, False, False]
