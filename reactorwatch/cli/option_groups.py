"""Groups of options as parameters of a command, and the group about the form of a record's file."""

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Annotated, Any

import typer
from typer import Option

from reactorwatch.records.file_format import FileFormat


@dataclass(frozen=True)
class TableOptions:
    """Form of a table; see `FileFormat`."""

    time: Annotated[str | None, Option(help="The time column, by its header or number [by name and content].")] = None
    time_unit: Annotated[
        str | None,
        Option(
            help="Unit of a time column of numbers: s, min, h, d, ms, us or ns; iso: timestamps [by its name, else s]."
        ),
    ] = None
    time_format: Annotated[
        str | None, Option(help="Format of timestamps, such as '%d.%m.%Y %H:%M:%S' [by their form].")
    ] = None
    sheet: Annotated[
        str | None,
        Option(
            hidden=True, rich_help_panel="file", help="The sheet of a workbook, by name or number [the first table]."
        ),
    ] = None
    dates: Annotated[
        str | None, Option(help="Order in dates such as 03/04/2026, month-first or day-first [by all rows].")
    ] = None
    zone: Annotated[
        str | None, Option(help="Time zone of local timestamps, such as Europe/Berlin or +01:00 [UTC].")
    ] = None
    period: Annotated[str | None, Option(help="Time between rows without a time column, such as '4 s'.")] = None
    separator: Annotated[str | None, Option(help="Character between cells, or tab or blank [by the first rows].")] = (
        None
    )
    decimal: Annotated[str | None, Option(help="Decimal sign, '.' or ',' [by all cells].")] = None
    missing: Annotated[list[str] | None, Option(help="A cell that means: not measured, such as -999 (repeatable).")] = (
        None
    )
    header: Annotated[
        bool | None, Option("--header/--no-header", help="The file has a header [by the first rows].")
    ] = None
    transposed: Annotated[
        bool | None, Option("--transposed/--no-transposed", help="Each row is a signal [by the first rows].")
    ] = None
    tag: Annotated[
        str | None, Option(help="The column of tags of a table with a row for each value; none: wide [by its rows].")
    ] = None
    value: Annotated[str | None, Option(help="The column of values of such a table [by its name and content].")] = None
    quality_good: Annotated[
        list[str] | None,
        Option(help="Qualities of usable values, such as 'Good,192', or '*' (repeatable) [words and codes of OPC]."),
    ] = None

    stated: FileFormat = field(init=False)

    def __post_init__(self) -> None:
        values = {item.name: getattr(self, item.name) for item in fields(FileFormat)}
        lists = {name: tuple(values[name] or ()) for name in ("missing", "quality_good")}
        object.__setattr__(self, "stated", FileFormat(**{**values, **lists}))


def stated_settings(stated: FileFormat) -> dict[str, Any] | None:
    """Table of settings with what is stated about a file; None: nothing is."""
    return {name: value for name, value in asdict(stated).items() if value not in (None, ())} or None


Command = Callable[..., None] | tuple[Callable[..., None], str]
"""A function whose docstring is the help, or a function and its help."""


def add_commands(app: typer.Typer, commands: Mapping[str, Command]) -> None:
    """Add commands to an application, by name; a parameter that is a dataclass stands for its fields as options."""
    for name, command in commands.items():
        function, text = command if isinstance(command, tuple) else (command, None)
        app.command(name, help=text)(_expand_groups(function))


def new_group(commands: Mapping[str, Command]) -> typer.Typer:
    """Make an application of subcommands, by name; see `add_commands`."""
    group = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
    add_commands(group, commands)
    return group


def _expand_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options of each group in its place."""
    parameters = inspect.signature(command).parameters.values()
    groups: dict[str, Any] = {item.name: item.annotation for item in parameters if is_dataclass(item.annotation)}

    @functools.wraps(command)
    def run(**given: Any) -> None:
        made = {
            name: kind(**{item.name: given.pop(item.name) for item in fields(kind) if item.init})
            for name, kind in groups.items()
        }
        command(**given, **made)

    shown = [option for item in parameters for option in _options_of(item)]
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
        if item.init
    ]
