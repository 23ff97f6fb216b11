"""Entry of the command: its subcommands, and one line and exit code 2 for a usage error.

Any other error is a fault of this software and is reported as in every process (`runtime/crash.py`).

Only the imports for `--help` are here; each command imports its own when it is called.
"""

import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, cast

import typer

from reactorwatch.cli import (
    alarm,
    baseline,
    causes,
    charts,
    examples,
    files,
    models,
    nodes,
    recordings,
    runs,
    site,
    studies,
    view,
)
from reactorwatch.cli.interrupt import clear_interrupt, raise_until_handled
from reactorwatch.cli.option_groups import Command, add_commands
from reactorwatch.cli.printing import print_lines
from reactorwatch.runtime.crash import INTERRUPTED, UNUSABLE, guard, print_error
from reactorwatch.version import this_build

# Typer brings a copy of click, or uses the one installed, depending on its version; its errors are one family in both.
UsageProblem: type[typer.BadParameter] = next(
    cast(type[typer.BadParameter], kind) for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"
)

NAME = "reactorwatch"

LIMITS_FILE = "REACTORWATCH_LIMITS"
"""Environment variable with the path of a settings file whose limits hold, for commands that take no settings."""

app = typer.Typer(
    name=NAME,
    help="Watches a process plant as it runs, and explains it when it misbehaves.",
    no_args_is_help=True,
    rich_markup_mode=None,  # importing rich for the help alone takes longer than all the rest
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS: dict[str, Command] = {
    "up": runs.up,
    "demo": runs.demo,
    "plant": nodes.plant,
    "monitor": nodes.monitor,
    "record": nodes.record,
    "replay": nodes.replay,
    "example": examples.example,
    "view": view.view,
    "certify": site.certify,
    "router": site.router,
    "doctor": site.doctor,
    "status": site.status,
    "ack": (alarm.acknowledge, "Acknowledge alarms: short for `alarm acknowledge`."),
    "dashboard": files.dashboard,
    "import": files.import_csv,
    "export": files.export_csv,
    "recover": recordings.recover,
    "info": recordings.info,
    "cut": recordings.cut,
    "simulate": studies.simulate,
    "backtest": studies.backtest,
    "diagnose": studies.diagnose,
    "causes": causes.causes,
    "identify": models.identify,
    "linearise": models.linearise,
}
add_commands(app, COMMANDS)
for name, group, text in (
    ("alarm", alarm.alarms, "List, acknowledge, shelve, suppress or comment the alarms of a plant."),
    ("baseline", baseline.baselines, "Accept, relearn or restore the baseline of a plant."),
    ("charts", charts.charts, "Control charts: how long they run, and which is fastest."),
):
    app.add_typer(group, name=name, help=text)


def _print_version(wanted: bool) -> None:
    if wanted:
        print_lines(f"reactorwatch {this_build()}")
        raise typer.Exit


@app.callback()
def _root(
    _version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Show the version."),
) -> None:
    """Watches a process plant as it runs, and explains it when it misbehaves."""


def main() -> None:
    """Run the command and end the process with its exit code."""
    run_command(_run)


def run_command(run: Callable[[], int]) -> NoReturn:
    """Run a command's work and end the process with its exit code, 130 after Ctrl-C."""
    # Before NumPy is imported: the matrices are small, and threads of the linear algebra would wait for each other
    # longer than they work; and the last bits of a chart's limit depend on their number. With one thread a back-test
    # reproduces the live monitor on any machine. Another setting has to be the same for both; nodes inherit it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("RUST_LOG", "off")  # a full disk or a closed viewer is reported here, not by Rerun
    raise_until_handled()

    def until_interrupted() -> int:
        try:
            return run()
        except (typer.Abort, KeyboardInterrupt):
            clear_interrupt()
            return INTERRUPTED

    code = guard(NAME, until_interrupted)
    gc.freeze()  # the process ends: garbage collection of a million objects would take a third of a second
    sys.exit(code)


def _run() -> int:
    try:
        if LIMITS_FILE in os.environ:
            from reactorwatch.runtime.config import read_settings

            read_settings(Path(os.environ[LIMITS_FILE]))
        code = app(prog_name=NAME, standalone_mode=False)
        sys.stdout.flush()
    except UsageProblem as error:
        print_error(NAME, error.format_message())
        return UNUSABLE
    return code if isinstance(code, int) else 0
