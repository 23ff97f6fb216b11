"""Readable output: aligned rows, and colours by meaning on a terminal.

On a terminal a row of cells takes one line, whose last cell is cut to fit; a file or a pipe gets the same text in full,
without colours. Colours: red for what is wrong now, yellow for what needs attention, green for what is right, cyan for
names of causes. `NO_COLOR` is respected.
"""

import contextlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from io import StringIO
from textwrap import wrap
from typing import NamedTuple

import typer

from reactorwatch.terminal import printable, printable_lines

WRONG, ATTENTION, RIGHT, CAUSE, FAINT, STRONG = "bold red", "yellow", "green", "cyan", "dim", "bold"
"""Styles by meaning."""

GAP = 2
"""Blanks between columns."""

_NAME = re.compile(r"\s+\S(?:\S| (?! ))*\s{2,}(?=\S)| *[A-Za-z][\w ]{1,20}: |- ")
_COLUMNS = re.compile(r"\S {3,}\S")

_MEANINGS = (
    (r"^(?:The simulation is right|no alarms|no gaps|nothing was damaged)(?s:.*)$", RIGHT),
    (r"the same alarms, value for value", RIGHT),
    (r"^(?:Detected|Raised|The simulation is wrong)\b(?s:.*)$", STRONG),
    (r"\((?:critical|high)\)|OTHER ALARMS|\bfailed\b", WRONG),
    (r"\(medium\)|^\s*note: |is not watched|^(?:not trustworthy yet|nothing was watched): ", ATTENTION),
    (r"(?<=cause named: )[^,\n]+|(?<=suspect: )[^\n]+", CAUSE),
)
"""Styles of what a report states, by pattern."""


class Cell(NamedTuple):
    """A text with a style.

    Attributes:
        text: one line of text.
        style: one of the styles of this module; empty: none.
    """

    text: str
    style: str = ""


Row = Sequence[Cell | str]


def print_rows(rows: Iterable[Row], indent: int = 0) -> None:
    """Print rows in aligned columns, one line each; see `format_rows`."""
    text = format_rows(list(rows), indent, width=screen_width(), colour=has_colour())
    if text:
        typer.echo(text)


def print_screen_text(text: str) -> None:
    """Print what a function of this module has formatted, in which all texts are printable."""
    typer.echo(text)


def print_headline(text: str, style: str = STRONG) -> None:
    """Print a sentence, wrapped at words on a terminal."""
    width = screen_width()
    if width is None:
        typer.echo(printable(text))
        return
    from rich.text import Text

    typer.echo(_render([Text(printable(text), style)], width, colour=has_colour()))


def print_report(text: str, *, as_json: bool = False) -> None:
    """Print a text of several lines: wrapped and coloured on a terminal, elsewhere as it is."""
    width = None if as_json else screen_width()
    lines = [printable(line) for line in text.split("\n")]
    typer.echo("\n".join(lines) if width is None else format_report(lines, width, colour=has_colour()))


def format_report(lines: Sequence[str], width: int, *, colour: bool) -> str:
    """Format the lines of a report for a terminal.

    Sentences are wrapped at words, and the value of a `  name   value` line below itself. A line with more columns is a
    row of a table, and is cut.
    """
    from rich.text import Text

    shown = []
    for line in lines:
        prefix, value = _split_name(line)
        rows = [_cut(line, width)] if _COLUMNS.search(value) else _wrap(line, len(prefix), width)
        text = Text("\n".join(rows))
        text.stylize(FAINT, 0, len(prefix))
        for meaning, style in _MEANINGS:
            text.highlight_regex(meaning, style)
        shown.append(text)
    return _render(shown, 10_000, colour=colour)


def _split_name(line: str) -> tuple[str, str]:
    match = _NAME.match(line)
    prefix = match[0] if match is not None else ""
    return prefix, line[len(prefix) :]


def _wrap(line: str, indent: int, width: int) -> list[str]:
    """Wrap a line at words; where nothing would fit beside its name, below it."""
    blanks = indent if indent < width // 2 else len(line) - len(line.lstrip()) + GAP
    wrapped = wrap(
        line,
        max(width, 20),
        subsequent_indent=" " * blanks,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        replace_whitespace=False,
    )
    return wrapped or [""]


def format_rows(rows: Sequence[Row], indent: int = 0, *, width: int | None = None, colour: bool = False) -> str:
    """Format rows in aligned columns, one line each."""
    cells = [[_cell(item) for item in row] for row in rows]
    columns = max(map(len, cells), default=0)
    widths = [max(_length(row[i].text) for row in cells if i < len(row)) for i in range(columns)]
    lines = []
    for row in cells:
        parts, used = [Cell(" " * indent)], indent
        for index, (text, style) in enumerate(row):
            shown = _cut(text, None if width is None else width - used)
            blanks = 0 if index == len(row) - 1 else widths[index] - _length(shown) + GAP
            if width is not None:
                blanks = min(blanks, width - used - _length(shown))
            parts += [Cell(shown, style), Cell(" " * blanks)]
            used += _length(shown) + blanks
        lines.append(parts)
    if not colour:
        return "\n".join("".join(text for text, _ in parts).rstrip() for parts in lines)
    from rich.text import Text

    return _render([Text.assemble(*((text, style) for text, style in parts)) for parts in lines], 10_000, colour=True)


def format_age(seconds: float) -> str:
    """Format an age with its largest unit.

    >>> format_age(45.2), format_age(754.0), format_age(7300.0), format_age(200_000.0)
    ('45 s', '13 min', '2.0 h', '2.3 d')
    """
    for unit, size, decimals in (("d", 86_400.0, 1), ("h", 3600.0, 1), ("min", 60.0, 0)):
        if seconds >= size:
            return f"{seconds / size:.{decimals}f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"


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


def screen_width() -> int | None:
    """Width of the terminal; None: the output goes elsewhere."""
    if not sys.stdout.isatty():
        return None
    from rich.console import Console

    return Console().width


def has_colour() -> bool:
    """True if the output goes to a terminal that shows colours."""
    if not sys.stdout.isatty():
        return False
    from rich.console import Console

    return Console().color_system is not None


def _render(texts: Sequence[object], width: int, *, colour: bool) -> str:
    """Lines of rich texts, with escape sequences where colour is wanted."""
    from rich.console import Console

    file = StringIO()
    console = Console(
        file=file,
        width=width,
        color_system="standard" if colour else None,
        force_terminal=colour,
        no_color=not colour,
        highlight=False,
    )
    for text in texts:
        console.print(text, soft_wrap=width >= 10_000)
    return file.getvalue().rstrip("\n")


def print_lines(*lines: str, err: bool = False) -> None:
    """Print lines without line breaks and control characters in them."""
    typer.echo(printable_lines(lines), err=err)


def print_text(text: str) -> None:
    """Print a text of several lines; see `printable_lines`."""
    print_lines(*text.split("\n"))


def json_line(value: object) -> str:
    """Format as JSON on one line."""
    import msgspec

    return msgspec.json.encode(value).decode()


Advance = Callable[[float, str], None]


def _escape_markup(text: str) -> str:
    """Escape a text, which may hold names of files, for the terminal and for Rich."""
    from rich.markup import escape

    return escape(printable(text))


@contextlib.contextmanager
def bar(text: str, total: float | None) -> Iterator[Advance]:
    """Show a bar while the context lasts; yields a function of the progress and a text."""
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
