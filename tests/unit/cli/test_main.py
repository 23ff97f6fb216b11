"""The command's entry: help, options, interrupts, compiled kernels, and what is settled before a subcommand runs."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numba
import pytest
import typer
from llvmlite.binding import ExecutionEngine, create_pass_builder
from llvmlite.binding.ffi import ObjectRef

from reactorwatch.cli.main import _BINDING, COMMANDS, app, clear_interrupt, main, raise_until_handled, run_command
from reactorwatch.codegen.numba_kernel import jit
from tests.running import WITHIN_S

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


@pytest.mark.parametrize("slow", ["numpy", "structlog", "asyncio", "rich"])
def test_help_imports_nothing_that_is_slow_and_threads_are_settled_before_numpy(slow: str) -> None:
    question = f"import sys, reactorwatch.cli.main; sys.exit({slow!r} in sys.modules)"
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


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGALRM)}
    raise_until_handled()
    yield
    clear_interrupt()
    for number, handler in before.items():
        signal.signal(number, handler)


def test_an_interrupt_that_was_dropped_is_raised_again() -> None:
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.pause()


def test_an_interrupt_that_was_handled_is_not_raised_again() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    clear_interrupt()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_an_alarm_that_comes_after_the_interrupt_was_cleared_does_nothing() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    on_its_way = signal.getsignal(signal.SIGALRM)
    clear_interrupt()
    signal.raise_signal(signal.SIGALRM)
    assert callable(on_its_way)
    on_its_way(signal.SIGALRM, None)  # Python calls handlers later than signals come
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


CODE_OF_THE_BINDING = """
def callback(interrupt):
    interrupt()
    done.append("callback")


class Builder:
    def __init__(self, interrupt):
        interrupt()
        self.made = True

    def __del__(self):
        done.append(f"{self.made}")
"""


@pytest.mark.parametrize(("called", "result"), [("callback", "callback"), ("Builder", "True")])
def test_an_interrupt_within_the_binding_of_the_compiler_is_raised_behind_it(called: str, result: str) -> None:
    done: list[str] = []
    module = {"__name__": f"{_BINDING}.somewhere", "done": done}
    exec(CODE_OF_THE_BINDING, module)
    module[called](lambda: signal.raise_signal(signal.SIGINT))  # type: ignore[operator]
    assert done == [result]
    with pytest.raises(KeyboardInterrupt):
        signal.pause()


def test_nothing_is_raised_while_an_interrupt_is_cleaned_up_after() -> None:
    is_cleaned = []

    def command() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.pause()  # until the next time that it would be raised
            is_cleaned.append(True)

    with pytest.raises(KeyboardInterrupt):
        command()
    assert is_cleaned


def test_nothing_is_raised_while_a_generator_is_closed_for_an_interrupt() -> None:
    is_closed = []

    def work() -> Generator[int]:
        try:
            yield from range(2)
        finally:
            signal.pause()  # until the next time that it would be raised
            is_closed.append(True)

    def command() -> None:
        with closing(work()) as results:
            next(results)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        command()
    assert is_closed


def interrupt_within_compiled_code() -> int:
    """As CPython reports it when compiled code returns a result in spite of the exception of a function it called."""
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as interrupt:
        raise SystemError("returned a result with an exception set") from interrupt
    return 0


def interrupt_before_a_failing_cleanup() -> int:
    opened: list[int] = []
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        opened.pop()
    return 0


@pytest.mark.parametrize("work", [interrupt_within_compiled_code, interrupt_before_a_failing_cleanup])
def test_an_error_that_an_interrupt_led_to_ends_the_command_as_the_interrupt(
    work: Callable[[], int], capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run_command(work)
    assert (ended.value.code, capfd.readouterr().err) == (130, "")


@pytest.mark.parametrize("part", [ExecutionEngine, ObjectRef, create_pass_builder])
def test_the_binding_has_the_name_that_is_looked_for(part: object) -> None:
    assert part.__module__.startswith(_BINDING)


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
from reactorwatch.runtime.node_main import configure_log
from reactorwatch.cli import kernels as compilation
from reactorwatch.process.library.cstr import cstr
from reactorwatch.codegen.compiled_function import CodeCache

made, keep = [], CodeCache._store
CodeCache._store = lambda self, path, code: made.append(path.name)
parts = sum(1 for _ in preparation(MonitorConfig(), cstr()))
CodeCache._store = keep
print(parts, len(made))
configure_log()  # on standard error
compilation.FAULT = "feed_temperature:step:3@40min"
compilation.compile_kernels()
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
