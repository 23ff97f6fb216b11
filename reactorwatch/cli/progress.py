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
def task(text: str) -> Iterator[None]:
    """Show a spinner while the context lasts."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        progress.add_task(_escape_markup(text), total=None)
        yield


@contextlib.contextmanager
def bar(text: str, total: float) -> Iterator[Advance]:
    """Show a bar while the context lasts; yields a function of the progress and a text."""
    if not sys.stderr.isatty():
        yield lambda _completed, _now: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        number = progress.add_task(_escape_markup(text), total=total)

        def advance(completed: float, now: str) -> None:
            progress.update(number, completed=completed, description=_escape_markup(now))

        yield advance
