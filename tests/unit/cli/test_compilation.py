"""After `python -m reactorwatch.codegen` no monitor and no diagnosis compiles a kernel: each is on the disk."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numba
import pytest

from reactorwatch.codegen.numba_kernel import jit
from tests.running import WITHIN_S

PROGRAM = """
import numba

kernels, njit = [], numba.njit


def register(*function, **options):
    if function:  # of Numba itself
        return njit(*function, **options)

    def wrap(kernel):
        kernels.append(njit(**options)(kernel))
        return kernels[-1]

    return wrap


numba.njit = register
from monitor_node.config import MonitorConfig
from monitor_node.causes.stage import preparation
from reactorwatch.cli import kernels
from reactorwatch.process.library.cstr import cstr
from reactorwatch.codegen.cache import CodeCache

made, keep = [], CodeCache._store
CodeCache._store = lambda self, path, code: made.append(path.name)
parts = sum(1 for _ in preparation(MonitorConfig(), cstr()))
CodeCache._store = keep
print(parts, len(made))
kernels.FAULT = "feed_temperature:step:3@40min"
kernels.compile_kernels()
print(sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels))
print([kernel.__name__ for kernel in kernels if kernel.stats.cache_misses])
"""


@pytest.mark.slow
def test_another_record_finds_every_kernel_compiled() -> None:
    command = [sys.executable, "-m", "reactorwatch.codegen"]
    subprocess.run(command, check=True, capture_output=True)
    run = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True)
    prepared, hits, missed = run.stdout.splitlines()
    parts, made = map(int, prepared.split())
    assert (parts > 10, made) == (True, 0)  # all that a look for causes needs was on the disk
    assert int(hits) > 10
    assert missed == "[]"


@pytest.mark.parametrize(
    "command", [["reactorwatch.codegen"], ["reactorwatch", "diagnose", "record.csv"]], ids=lambda command: command[0]
)
def test_ctrl_c_while_kernels_are_compiled_ends_the_command_in_order(command: list[str], tmp_path: Path) -> None:
    """On a new machine; the interrupt comes when the first kernel is stored, while the next one is compiled."""
    python = [sys.executable, "-m"]
    example = [*python, "reactorwatch", "example", "leak", "-o", "record.csv"]
    subprocess.run(example, cwd=tmp_path, check=True, capture_output=True)
    cache = tmp_path / "cache"
    fresh = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "XDG_CACHE_HOME": str(cache)}
    process = subprocess.Popen(
        [*python, *command], cwd=tmp_path, env=fresh, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while not any(cache.rglob("*.nbc")):
        with suppress(subprocess.TimeoutExpired):
            pytest.fail(f"ended with {process.wait(0.05)} before it had stored a kernel")
    process.send_signal(signal.SIGINT)
    said, error = process.communicate(timeout=WITHIN_S)
    assert (process.returncode, said) == (130, "")
    assert "Traceback" not in error


def test_a_kernel_compiles_where_no_folder_can_be_written_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])

    def double(x: float) -> float:
        return 2.0 * x

    assert jit(double)(2.0) == 4.0
