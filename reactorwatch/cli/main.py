"""The command's entry: gathers the subcommands, and turns a person's mistakes into one line and exit code 2.

What is raised and is no mistake of a person's is a fault of ours: it ends in one line, too, which names a file with the
traceback, and in exit code 70.

Only what `--help` needs is imported here; each command imports its own when it is called.
"""

import errno
import gc
import os
import sys
from contextlib import suppress
from typing import cast

import typer

from reactorwatch import __version__
from reactorwatch.cli import (
    alarm,
    charts,
    compilation,
    files,
    models,
    nodes,
    playback,
    recordings,
    runs,
    site,
    studies,
    view,
)
from reactorwatch.cli.interrupt import handled, raise_until_handled
from reactorwatch.cli.printing import say
from reactorwatch.errors import InputError

# Typer brings a copy of click, or uses the one installed, depending on its version; its errors are one family in both.
UsageProblem: type[typer.BadParameter] = next(
    cast(type[typer.BadParameter], kind) for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"
)

_NAMES = "EACCES EDQUOT EFBIG EIO EISDIR ELOOP EMFILE ENAMETOOLONG ENFILE ENOSPC ENOTDIR EPERM EROFS"
OF_THE_SYSTEM = frozenset(getattr(errno, name) for name in _NAMES.split(" "))
"""Errors that say something about a file or a disk, and nothing about this software."""

app = typer.Typer(
    name="reactorwatch",
    help="Watches a chemical reactor as it runs, and explains it when it misbehaves.",
    no_args_is_help=True,
    rich_markup_mode=None,  # importing rich for the help alone takes longer than all the rest
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (runs, nodes, view, site, playback, alarm, files, recordings, studies, models, charts, compilation):
    group.add_to(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        say(f"reactorwatch {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    _version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Show the version."),
) -> None:
    """Watches a chemical reactor as it runs, and explains it when it misbehaves."""


def main() -> None:
    """Run the command and end the process with its exit code."""
    # Before NumPy is imported: our matrices are small, and threads of the linear algebra would wait for each other
    # longer than they work; and the last bits of a chart's limit depend on how many they are. So a back-test says what
    # the live monitor said, on whatever machine. Who sets it otherwise has to do so for both; nodes inherit it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("RUST_LOG", "off")  # what Rerun logs of a full disk or a closed viewer, we say ourselves
    raise_until_handled()
    try:
        code = app(prog_name="reactorwatch", standalone_mode=False)
        sys.stdout.flush()
    except UsageProblem as error:
        _complain(error.format_message())
        code = 2
    except InputError as error:
        _complain(str(error))
        code = 2
    except (typer.Abort, KeyboardInterrupt):
        handled()
        code = 130
    except Exception as error:  # noqa: BLE001 (the one place that turns what is left into a report)
        if isinstance(error, OSError) and error.errno in OF_THE_SYSTEM:
            _complain(f"{error.filename or 'what is said here cannot be written'}: {error.strerror}")
            sys.exit(2)
        from reactorwatch.cli.crash import EXIT_CODE, report_crash

        _complain(report_crash(error))
        code = EXIT_CODE
    gc.freeze()  # the process ends: to look for garbage among a million objects would take a third of a second
    sys.exit(code if isinstance(code, int) else 0)


def _complain(text: str) -> None:
    line = " ".join(text.split())
    with suppress(OSError):  # the exit code says it, too
        say(f"reactorwatch: {line}", err=True)
