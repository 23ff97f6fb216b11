"""Entry of the command: its subcommands, and one line and exit code 2 for a usage error.

Any other error is a fault of this software and is reported as in every process (`runtime/node_main.py`).

Only the imports for `--help` are here; each command imports its own when it is called.
"""

import atexit
import gc
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, cast

import typer
from typer.core import TyperGroup

from reactorwatch.cli import alarm, my_data, my_plant, recordings, site, studies
from reactorwatch.cli.display import print_lines
from reactorwatch.cli.option_groups import Command, add_commands
from reactorwatch.errors import InputError, UnavailableError
from reactorwatch.runtime.node_main import INTERRUPTED, UNUSABLE, guard, print_error
from reactorwatch.version import this_build

# Typer brings a copy of click, or uses the one installed, depending on its version; its errors are one family in both.
UsageProblem: type[typer.BadParameter] = next(
    cast(type[typer.BadParameter], kind) for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"
)

NAME = "reactorwatch"
LIMITS_FILE = "REACTORWATCH_LIMITS"
"""Environment variable with the path of a settings file whose limits hold, for commands that take no settings."""

COMMANDS: dict[str, dict[str, Command | typer.Typer]] = {
    "My data": {
        "info": my_data.info,
        "backtest": my_data.backtest,
        "identify": my_data.identify,
        "diagnose": my_data.diagnose,
        "causes": my_data.causes,
        "simulate": my_data.simulate,
        "example": my_data.example,
    },
    "My plant": {
        "up": my_plant.up,
        "plant": my_plant.plant,
        "monitor": my_plant.monitor,
        "status": my_plant.status,
        "alarm": alarm.alarms,
        "baseline": alarm.baselines,
        "view": my_plant.view,
    },
    "Recordings": {
        "record": recordings.record,
        "replay": recordings.replay,
        "import": recordings.import_csv,
        "export": recordings.export_csv,
        "dashboard": recordings.dashboard,
        "cut": recordings.cut,
        "recover": recordings.recover,
    },
    "Site": {"router": site.router, "certify": site.certify, "doctor": site.doctor},
    "Studies": {"linearise": studies.linearise, "charts": studies.charts, "demo": studies.demo},
}
"""Commands by person, as the help lists them."""


class _Root(TyperGroup):
    """The command, whose help lists its commands by person."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each person."""
        width = max(len(name) for group in COMMANDS.values() for name in group)
        for person, group in COMMANDS.items():
            with formatter.section(person):
                limit = formatter.width - 6 - width
                texts = {name: self.commands[name].get_short_help_str(limit) for name in group}
                formatter.write_dl([(f"{name:{width}}", text) for name, text in texts.items()])


app = typer.Typer(
    cls=_Root,
    name=NAME,
    help="Watches a process plant as it runs, and explains it when it misbehaves.",
    no_args_is_help=True,
    rich_markup_mode=None,  # importing rich for the help alone takes longer than all the rest
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _group in COMMANDS.values():
    for _name, _command in _group.items():
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, name=_name)
        else:
            add_commands(app, {_name: _command})
add_commands(app, {"ack": alarm.acknowledge}, hidden=True)


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
        except BaseException as error:
            # Raised within compiled code, an interrupt is the cause of a SystemError. A file that cannot be finished
            # after it is said nevertheless.
            is_reported = isinstance(error, InputError | UnavailableError | OSError)
            if isinstance(error, typer.Abort) or (_is_handled(error) and not is_reported):
                clear_interrupt()
                return INTERRUPTED
            raise

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


AGAIN_S = 0.2  # a compiler drops an interrupt for less
_BINDING = "llvmlite.binding"
"""Package whose code calls LLVM; a callback of LLVM runs within it."""


def raise_until_handled() -> None:
    """Let SIGINT raise KeyboardInterrupt in the main thread, repeatedly until `clear_interrupt` is called."""
    signal.signal(signal.SIGINT, _interrupt)
    atexit.register(clear_interrupt)


def clear_interrupt() -> None:
    """Stop raising for the interrupts so far; an alarm that comes yet is ignored, also while the interpreter ends."""
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, 0.0)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGINT:
        signal.signal(signal.SIGALRM, _interrupt)
    elif signal.getsignal(signal.SIGALRM) is signal.SIG_IGN:  # it was on its way when the interrupts were cleared
        return
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    if _is_handled(sys.exception()):
        return
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith(_BINDING):
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _is_handled(error: BaseException | None) -> bool:
    """True for an interrupt and for what it led to, such as the GeneratorExit of a generator that it closes."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__context__
    return False
