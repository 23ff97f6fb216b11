"""Progress for people: only on a terminal, and on standard error, so that what a command prints stays clean.

What is printed meanwhile goes above the bar if it goes to the terminal, too; into a file it goes as it is.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator

from reactorwatch.terminal import printable

Advance = Callable[[float, str], None]


def _unmarked(text: str) -> str:
    """A text that neither the terminal nor Rich takes for more than it is: names of files are in it."""
    from rich.markup import escape

    return escape(printable(text))


@contextlib.contextmanager
def task(text: str) -> Iterator[None]:
    """A spinner while something of unknown length runs."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        progress.add_task(_unmarked(text), total=None)
        yield


@contextlib.contextmanager
def bar(text: str, total: float) -> Iterator[Advance]:
    """A bar while something of known length runs; call what it gives with (how far, what is going on)."""
    if not sys.stderr.isatty():
        yield lambda _completed, _now: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty()) as progress:
        number = progress.add_task(_unmarked(text), total=total)

        def advance(completed: float, now: str) -> None:
            progress.update(number, completed=completed, description=_unmarked(now))

        yield advance
