"""Ctrl-C ends a command, also where the compiler drops what is raised, and interrupts no cleaning up."""

import signal
from collections.abc import Generator, Iterator
from contextlib import closing

import pytest
from llvmlite.binding import ExecutionEngine, create_pass_builder
from llvmlite.binding.ffi import ObjectRef

from reactorwatch.cli.main import _BINDING, clear_interrupt, raise_until_handled


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


@pytest.mark.parametrize("part", [ExecutionEngine, ObjectRef, create_pass_builder])
def test_the_binding_has_the_name_that_is_looked_for(part: object) -> None:
    assert part.__module__.startswith(_BINDING)
