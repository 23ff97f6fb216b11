"""Progress of a long computation, for a command that shows it: stages with counts. Nothing is printed here."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Report = Callable[[str, int, int], None]
"""Called with a stage, the number of the step that begins, and the number of steps; 0: not known."""

Item = TypeVar("Item")
_report: ContextVar[Report | None] = ContextVar("report", default=None)


@contextmanager
def reporting_to(report: Report) -> Iterator[None]:
    """Send the stages of what runs in the context, in this thread, to a function."""
    token = _report.set(report)
    try:
        yield
    finally:
        _report.reset(token)


def report_stage(stage: str, step: int = 0, steps: int = 0) -> None:
    """Report that a step of a stage begins."""
    report = _report.get()
    if report is not None:
        report(stage, step, steps)


def track(stage: str, items: Sequence[Item]) -> Iterator[Item]:
    """Iterate over the steps of a stage, and report each."""
    for step, item in enumerate(items, start=1):
        report_stage(stage, step, len(items))
        yield item
