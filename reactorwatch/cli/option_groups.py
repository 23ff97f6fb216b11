"""Options of commands as dataclasses, and the two groups of them that `--help` folds.

A parameter of a command that is a dataclass stands for its fields as options. Options about the form of a file, and
those about bus and settings, are the same for many commands: `--help` has one line for each of these groups, and
`--help-file` and `--help-bus` show them.
"""

import copy
import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer import Option

from reactorwatch.cli.display import print_lines
from reactorwatch.cli.options import MAX_WAIT_S, parse_columns, split_at_commas
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import FileFormat

if TYPE_CHECKING:
    from reactorwatch.description.read import ProcessChoice

FILE, BUS = "file", "bus"
GROUPS = {FILE: "How to read the file", BUS: "Bus and settings"}
"""Titles of the folded groups; an option is in one by its `rich_help_panel`."""

_NAMED = 4
"""Options that the line of a group names: more take a second line on a terminal of 80 columns."""


def fold(group: str, *names: str, **about: Any) -> Any:
    """An option of a group that `--help` folds; the arguments are those of `typer.Option`."""
    return Option(*names, hidden=True, rich_help_panel=group, **about)


@dataclass(frozen=True)
class TableOptions:
    """Form of a table; see `FileFormat`."""

    time: Annotated[str | None, fold(FILE, help="The time column, by its header or number [by name and content].")] = (
        None
    )
    time_unit: Annotated[
        str | None,
        fold(
            FILE,
            help="Unit of a time column of numbers: s, min, h, d, ms, us or ns; iso: timestamps [by its name, else s].",
        ),
    ] = None
    time_format: Annotated[
        str | None, fold(FILE, help="Format of timestamps, such as '%d.%m.%Y %H:%M:%S' [by their form].")
    ] = None
    sheet: Annotated[
        str | None,
        fold(FILE, help="The sheet of a workbook, by name or number [the first table]."),
    ] = None
    dates: Annotated[
        str | None, fold(FILE, help="Order in dates such as 03/04/2026, month-first or day-first [by all rows].")
    ] = None
    zone: Annotated[
        str | None, fold(FILE, help="Time zone of local timestamps, such as Europe/Berlin or +01:00 [UTC].")
    ] = None
    period: Annotated[str | None, fold(FILE, help="Time between rows without a time column, such as '4 s'.")] = None
    separator: Annotated[
        str | None, fold(FILE, help="Character between cells, or tab or blank [by the first rows].")
    ] = None
    decimal: Annotated[str | None, fold(FILE, help="Decimal sign, '.' or ',' [by all cells].")] = None
    missing: Annotated[
        list[str] | None, fold(FILE, help="A cell that means: not measured, such as -999 (repeatable).")
    ] = None
    header: Annotated[
        bool | None, fold(FILE, "--header/--no-header", help="The file has a header [by the first rows].")
    ] = None
    transposed: Annotated[
        bool | None, fold(FILE, "--transposed/--no-transposed", help="Each row is a signal [by the first rows].")
    ] = None
    tag: Annotated[
        str | None,
        fold(FILE, help="The column of tags of a table with a row for each value; none: wide [by its rows]."),
    ] = None
    value: Annotated[str | None, fold(FILE, help="The column of values of such a table [by its name and content].")] = (
        None
    )
    quality_good: Annotated[
        list[str] | None,
        fold(
            FILE, help="Qualities of usable values, such as 'Good,192', or '*' (repeatable) [words and codes of OPC]."
        ),
    ] = None
    resample: Annotated[
        str | None,
        fold(
            FILE,
            help="Make rows of this period, such as '10 s', or auto; methods may follow, for all signals or some: "
            "auto,last,T=interpolated (mean, last, interpolated, sparse) [the rows of the file].",
        ),
    ] = None

    @property
    def file_format(self) -> FileFormat:
        """The form as it is stated."""
        values = {item.name: getattr(self, item.name) for item in fields(FileFormat)}
        lists = {name: tuple(values[name] or ()) for name in ("missing", "quality_good")}
        return FileFormat(**{**values, **lists})


@dataclass(frozen=True)
class PlantTableOptions(TableOptions):
    """Form of a table, and the plant of a recording."""

    plant: Annotated[str | None, fold(FILE, "--plant", help="Name of the plant in a recording [the only one].")] = None


@dataclass(frozen=True)
class ColumnOptions:
    """Names of columns."""

    column: Annotated[
        list[str] | None, fold(FILE, help="A column of another name, as signal=column: --column T=reactor_temp.")
    ] = None

    @property
    def columns(self) -> dict[str, str]:
        """Names of columns by signal."""
        return parse_columns(self.column)


@dataclass(frozen=True)
class RecordOptions(PlantTableOptions, ColumnOptions):
    """Form of a table, its columns, and the plant of a recording."""


@dataclass(frozen=True)
class ProcessOption:
    """The process, by its name or file."""

    process: Annotated[
        str | None,
        Option("--process", help="A process: a name in the catalogue, or a .toml, .py or extended.json file [cstr]."),
    ] = None
    model: Annotated[str | None, Option("--model", hidden=True, help="The older name of --process.")] = None

    def __post_init__(self) -> None:
        if self.process is not None and self.model is not None:
            raise InputError("--model is the older name of --process; give one of them")
        object.__setattr__(self, "process", self.process if self.process is not None else self.model)

    def choose(self) -> "ProcessChoice":
        """Choice of the process."""
        from reactorwatch.description.read import ProcessChoice

        return ProcessChoice(self.process)


@dataclass(frozen=True)
class ProcessOptions(ProcessOption):
    """The process of a record or a plant: as a whole, or by its columns."""

    inputs: Annotated[
        list[str] | None,
        fold(FILE, "--input", help="A column that is an input, without a process (repeatable, or with commas)."),
    ] = None
    outputs: Annotated[
        list[str] | None,
        fold(FILE, "--output", help="A column to watch, without a process (repeatable, or with commas)."),
    ] = None

    def choose(self, modes: list[str] | None = None) -> "ProcessChoice":
        """Choice of the process; the modes are columns that say how a process without a description is operated."""
        from reactorwatch.description.read import ProcessChoice

        return ProcessChoice(self.process, *(tuple(split_at_commas(it)) for it in (self.inputs, self.outputs, modes)))


@dataclass(frozen=True)
class TrainingOptions:
    """Length of a training."""

    training: Annotated[float | None, Option(help="Minutes to learn from [cstr: 100; else see --training-rows].")] = (
        None
    )
    training_rows: Annotated[
        int | None,
        Option(help="Rows to learn from, instead of minutes [1000, or a third of a record if that is fewer]."),
    ] = None

    @property
    def is_given(self) -> bool:
        """True if a length is given."""
        return self.training is not None or self.training_rows is not None

    def flags(self, tables: dict[str, dict[str, Any]]) -> dict[str, float | int | None]:
        """Settings of the monitor; a length that is given takes the place of one in the tables, which is removed."""
        flags = {"training_min": self.training, "training_rows": self.training_rows}
        if self.is_given:
            for name in flags:
                tables.get("monitor", {}).pop(name, None)
        return flags


@dataclass(frozen=True)
class SettingsOptions:
    """Settings file of a command."""

    config: Annotated[Path | None, fold(BUS, "--config", help="Settings file (TOML), a table for each node.")] = None


@dataclass(frozen=True)
class BusOptions(SettingsOptions):
    """Settings file and router of a command on the bus."""

    endpoint: Annotated[str | None, fold(BUS, help="Address of the router [tcp/127.0.0.1:7447].")] = None


@dataclass(frozen=True)
class PlantOptions(BusOptions):
    """Settings file, router and plant of a command on the bus."""

    name: Annotated[
        str | None,
        fold(BUS, "--plant", help="Name of the plant [of the settings or the file, else cstr; status: all]."),
    ] = None


@dataclass(frozen=True)
class ClientOptions(PlantOptions):
    """Settings file, router, plant and timeout of a command to nodes."""

    timeout: Annotated[float, fold(BUS, help="Seconds to wait for an answer.", min=0.1, max=MAX_WAIT_S)] = 5.0


def stated_settings(stated: FileFormat) -> dict[str, Any] | None:
    """Table of settings with what is stated about a file; None: nothing is."""
    return {name: value for name, value in asdict(stated).items() if value not in (None, ())} or None


Command = Callable[..., None] | tuple[Callable[..., None], str]
"""A function whose docstring is the help, or a function and its help."""


def add_commands(app: typer.Typer, commands: Mapping[str, Command], *, hidden: bool = False) -> None:
    """Add commands to an application, by name; a parameter that is a dataclass stands for its fields as options."""
    for name, command in commands.items():
        function, text = command if isinstance(command, tuple) else (command, None)
        app.command(name, help=text, hidden=hidden)(_expand_groups(function))


def new_group(text: str, commands: Mapping[str, Command]) -> typer.Typer:
    """Make an application of subcommands with its help; see `add_commands`."""
    group = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help=text)
    add_commands(group, commands)
    return group


def _expand_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of each group in its place."""
    parameters = inspect.signature(command).parameters.values()
    groups: dict[str, Any] = {item.name: item.annotation for item in parameters if is_dataclass(item.annotation)}

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for group in GROUPS:
            given.pop(f"help_{group}", None)
        made = {
            name: kind(**{item.name: given.pop(item.name) for item in fields(kind)}) for name, kind in groups.items()
        }
        command(**given, **made)

    shown = [option for item in parameters for option in _options_of(item)]
    for group in GROUPS:
        names = [_flag(option) for option in shown if _about(option).rich_help_panel == group]
        if names:
            shown.append(_help_option(group, names))
    run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined] # which Typer reads
    run.__annotations__ = {option.name: option.annotation for option in shown}
    return run


def _options_of(parameter: inspect.Parameter) -> list[inspect.Parameter]:
    """A parameter of a command as Typer reads it: itself, or the fields of its group."""
    if not is_dataclass(parameter.annotation):
        return [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)]
    return [
        inspect.Parameter(item.name, inspect.Parameter.KEYWORD_ONLY, default=item.default, annotation=item.type)
        for item in fields(parameter.annotation)
    ]


def _about(option: inspect.Parameter) -> Any:
    """Typer's description of an option or argument."""
    return get_args(option.annotation)[1]


def _flag(option: inspect.Parameter) -> str:
    """The option as it is typed."""
    about = _about(option)
    named = [item for item in (about.default, *(about.param_decls or ())) if isinstance(item, str)]
    return named[0] if named else f"--{option.name.replace('_', '-')}"


def _help_option(group: str, names: list[str]) -> inspect.Parameter:
    """The option that shows a folded group and ends the command; its help is the line of the group."""

    def show(context: typer.Context, wanted: bool) -> None:
        if not wanted:
            return
        formatter = context.make_formatter()
        options = [copy.copy(item) for item in context.command.params if getattr(item, "rich_help_panel", "") == group]
        for option in options:
            option.hidden = False  # type: ignore[attr-defined] # arguments are in no group
        with formatter.section(GROUPS[group]):
            formatter.write_dl([record for option in options if (record := option.get_help_record(context))])
        print_lines(*formatter.getvalue().rstrip().split("\n"))
        raise typer.Exit

    others = len(names) - _NAMED
    text = f"{GROUPS[group]}: {', '.join(names[:_NAMED])}{f' and {others} more' if others > 0 else ''}."
    option = Option(f"--help-{group}", is_eager=True, callback=show, help=text)
    name = f"help_{group}"
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, option])
