"""The one place where the command prints."""

import typer

from reactorwatch.terminal import printable_lines


def say(*lines: str, err: bool = False) -> None:
    """Print lines; each stays one, and none holds what a terminal would act on.

    Args:
        lines: to be printed.
        err: on standard error, not on standard output.
    """
    typer.echo(printable_lines(lines), err=err)


def say_text(text: str) -> None:
    """Print a text of several lines, whose parts from outside are in one line each; see `printable_lines`."""
    say(*text.split("\n"))
