"""Ctrl-C ends a command, also where the compiler drops what is raised, and interrupts no cleaning up."""

import signal
from collections.abc import Generator, Iterator
from contextlib import closing

import pytest
from llvmlite.binding import ExecutionEngine

from reactorwatch.cli.interrupt import _CALLBACKS, clear_interrupt, raise_until_handled


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


def test_an_interrupt_within_a_callback_of_the_compiler_is_raised_behind_it() -> None:
    is_done = []

    def _raw_object_cache_notify() -> None:
        signal.raise_signal(signal.SIGINT)
        is_done.append(True)

    _raw_object_cache_notify()
    assert is_done
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


def test_the_compiler_s_callbacks_have_the_names_that_are_looked_for() -> None:
    assert [name for name in vars(ExecutionEngine) if name.startswith(_CALLBACKS)]
