"""Terminal output: lines, aligned rows with styles by meaning, reports wrapped at words, and progress.

On a terminal a row takes one line, whose last cell is cut to fit; a file or a pipe gets the same text in full, without
colours. `NO_COLOR` is respected. Progress is shown on a terminal only, on standard error, above which output appears.
"""

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from textwrap import wrap
from typing import NamedTuple

import typer

from reactorwatch.progress import reporting_to
from reactorwatch.terminal import printable, printable_lines

WRONG, ATTENTION, RIGHT, CAUSE, FAINT, STRONG = "1;31", "33", "32", "36", "2", "1"
"""Styles by meaning, as parameters of a terminal's escape sequence: bold red for what is wrong now, yellow for what
needs attention, green for what is right, cyan for names of causes, dim, bold."""

GAP = 2
"""Blanks between columns."""

_LEAST_WIDTH = 20
"""Narrower than any word of a report but a path."""
_NAME = re.compile(r"\s+\S(?:\S| (?! ))*\s{2,}(?=\S)| *[A-Za-z][\w ]{1,20}: |- ")
"""The name before a value in a report: the further lines of the value start below it."""
_COLUMNS = re.compile(r"\S {3,}\S")
"""Blanks between the columns of a table's row, which is cut and not wrapped."""

Advance = Callable[[float, str], None]


class Cell(NamedTuple):
    """One line of text with a style; empty: none."""

    text: str
    style: str = ""


Row = Sequence[Cell | str]


class Screen(NamedTuple):
    """The terminal that the output goes to: its width, or None for a file or a pipe; and True if it shows colours."""

    width: int | None = None
    colour: bool = False


def screen() -> Screen:
    """The terminal of standard output."""
    if not sys.stdout.isatty():
        return Screen()
    has_colour = not os.environ.get("NO_COLOR") and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")
    return Screen(shutil.get_terminal_size().columns, has_colour)


def print_lines(*lines: str, err: bool = False) -> None:
    """Print lines, on standard error if `err`, without line breaks and control characters in them."""
    typer.echo(printable_lines(lines), err=err)


def print_rows(rows: Iterable[Row], indent: int = 0) -> None:
    """Print rows in aligned columns, one line each."""
    if text := format_rows(list(rows), indent, screen()):
        typer.echo(text)


def print_screen_text(text: str) -> None:
    """Print what a function of this module has formatted, in which all texts are printable."""
    typer.echo(text)


def print_headline(text: str, style: str = STRONG) -> None:
    """Print a sentence, wrapped at words on a terminal."""
    width, colour = screen()
    lines = wrap_line(printable(text), width)
    typer.echo("\n".join(_paint(line, style) if colour else line for line in lines))


def print_report(text: str, *, as_json: bool = False) -> None:
    """Print sentences, `  name   value` lines and tables, wrapped on a terminal; JSON stays as it is everywhere."""
    width = None if as_json else screen().width
    typer.echo("\n".join(row for line in text.split("\n") for row in wrap_line(printable(line), width)))


def json_line(value: object) -> str:
    """Format as JSON on one line."""
    import msgspec

    return msgspec.json.encode(value).decode()


def wrap_line(line: str, width: int | None) -> list[str]:
    """Wrap a line of a report: a value below itself, or below its name where nothing would fit beside that.

    A line with more columns is a row of a table, and is cut.
    """
    if width is None:
        return [line]
    match = _NAME.match(line)
    indent = len(match[0]) if match is not None else 0
    if _COLUMNS.search(line[indent:]):
        return [_cut(line, width)]
    blanks = indent if indent < width // 2 else len(line) - len(line.lstrip()) + GAP
    rows = wrap(
        line,
        max(width, _LEAST_WIDTH),
        subsequent_indent=" " * blanks,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
    return rows or [""]


def format_rows(rows: Sequence[Row], indent: int = 0, to: Screen = Screen()) -> str:  # noqa: B008 (it is frozen)
    """Format rows in aligned columns, one line each; a row may have fewer cells than others."""
    cells = [[_cell(item) for item in row] for row in rows]
    columns = max(map(len, cells), default=0)
    widths = [max(_length(row[i].text) for row in cells if i < len(row)) for i in range(columns)]
    lines = []
    for row in cells:
        line, used = " " * indent, indent
        for index, (text, style) in enumerate(row):
            shown = _cut(text, None if to.width is None else to.width - used)
            blanks = 0 if index == len(row) - 1 else widths[index] - _length(shown) + GAP
            if to.width is not None:
                blanks = min(blanks, to.width - used - _length(shown))
            line += (_paint(shown, style) if to.colour else shown) + " " * blanks
            used += _length(shown) + blanks
        lines.append(line.rstrip())
    return "\n".join(lines)


def format_age(seconds: float) -> str:
    """Format an age with its largest unit.

    >>> format_age(45.2), format_age(754.0), format_age(7300.0), format_age(200_000.0)
    ('45 s', '13 min', '2.0 h', '2.3 d')
    """
    for unit, size, decimals in (("d", 86_400.0, 1), ("h", 3600.0, 1), ("min", 60.0, 0)):
        if seconds >= size:
            return f"{seconds / size:.{decimals}f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"


def _paint(text: str, style: str) -> str:
    return f"\x1b[{style}m{text}\x1b[0m" if style and text else text


def _cell(item: Cell | str) -> Cell:
    text, style = item if isinstance(item, Cell) else Cell(item)
    return Cell(printable(text), style)


def _length(text: str) -> int:
    """Columns that a text takes on a terminal."""
    if text.isascii():
        return len(text)
    from rich.cells import cell_len

    return cell_len(text)


def _cut(text: str, room: int | None) -> str:
    if room is None or _length(text) <= room:
        return text
    while text and _length(text) >= room:
        text = text[:-1]
    return f"{text}…" if room > 0 else ""


def _escape_markup(text: str) -> str:
    """Escape a text, which may hold names of files, for the terminal and for Rich."""
    from rich.markup import escape

    return escape(printable(text))


@contextlib.contextmanager
def bar(text: str, total: float | None) -> Iterator[Advance]:
    """Show a bar, or a spinner without a total, while the context lasts; yields a function of progress and text."""
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


@contextlib.contextmanager
def task(text: str) -> Iterator[None]:
    """Show a spinner while the context lasts, with the stages that are reported in it (`reactorwatch.progress`)."""

    def show(stage: str, step: int, steps: int) -> None:
        count = f" {step} of {steps}" if steps else f" {step}" if step else ""
        advance(0, f"{text}: {stage}{count}")

    with bar(text, None) as advance, reporting_to(show):
        yield
