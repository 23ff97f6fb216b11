"""Progress display: only on a terminal, and on standard error, so that a command's output stays clean.

Output to the terminal appears above the bar; output to a file is unchanged.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator

from reactorwatch.terminal import printable

Advance = Callable[[float, str], None]


def _escape_markup(text: str) -> str:
    """Escape a text, which may hold names of files, for the terminal and for Rich."""
    from rich.markup import escape

    return escape(printable(text))


@contextlib.contextmanager
def bar(text: str, total: float | None) -> Iterator[Advance]:
    """Show a bar while the context lasts; yields a function of the progress and a text.

    Args:
        text: text beside the bar at first.
        total: progress at the end; None: a spinner is shown.
    """
    if not sys.stderr.isatty():
        yield lambda _completed, _now: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    label = TextColumn("{task.description}")
    columns = (
        (SpinnerColumn(), label, TimeElapsedColumn()) if total is None else (label, BarColumn(), TimeRemainingColumn())
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        number = progress.add_task(_escape_markup(text), total=total)

        def advance(completed: float, now: str) -> None:
            progress.update(number, completed=completed, description=_escape_markup(now))

        yield advance


def task(text: str) -> contextlib.AbstractContextManager[Advance]:
    """Show a spinner while the context lasts."""
    return bar(text, None)
