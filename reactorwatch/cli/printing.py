"""Output of the command."""

import typer

from reactorwatch.terminal import printable_lines


def print_lines(*lines: str, err: bool = False) -> None:
    """Print lines without line breaks and control characters in them.

    Args:
        lines: the lines.
        err: print on standard error instead of standard output.
    """
    typer.echo(printable_lines(lines), err=err)


def print_text(text: str) -> None:
    """Print a text of several lines; see `printable_lines`."""
    print_lines(*text.split("\n"))


def json_line(value: object) -> str:
    """Format as JSON on one line."""
    import msgspec

    return msgspec.json.encode(value).decode()
