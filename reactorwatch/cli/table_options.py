"""Options about the form of a record's file, for every command that reads one."""

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import typer

from reactorwatch.records.file_format import FileFormat

_TEXTS = {
    "time": "The time column, by its header or number [by name and content].",
    "time_unit": "Unit of a time column of numbers: s, min, h, d, ms, us or ns; iso: timestamps [by its name, else s].",
    "time_format": "Format of timestamps, such as '%d.%m.%Y %H:%M:%S' [by their form].",
    "zone": "Time zone of local timestamps, such as Europe/Berlin or +01:00 [UTC].",
    "period": "Time between rows without a time column, such as '4 s'.",
    "separator": "Character between cells, or tab or blank [by the first rows].",
    "decimal": "Decimal sign, '.' or ',' [by the first rows].",
}


def _text_option(name: str) -> Any:
    option = typer.Option(f"--{name.replace('_', '-')}", help=_TEXTS[name], show_default=False)
    return Annotated[str | None, option]


_OPTIONS: dict[str, Any] = {
    **{name: _text_option(name) for name in _TEXTS},
    "missing": Annotated[
        list[str] | None,
        typer.Option(help="A cell that means: not measured, such as -999 (repeatable).", show_default=False),
    ],
    "header": Annotated[
        bool | None,
        typer.Option("--header/--no-header", help="The file has a header [by the first rows].", show_default=False),
    ],
    "transposed": Annotated[
        bool | None,
        typer.Option(
            "--transposed/--no-transposed", help="Each row is a signal [by the first rows].", show_default=False
        ),
    ],
}


def take_table_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options about a file's form; it gets them as the argument `stated`."""
    signature = inspect.signature(command)

    @functools.wraps(command)
    def run(**arguments: Any) -> None:
        values = {name: arguments.pop(name) for name in _OPTIONS}
        missing = tuple(values.pop("missing") or ())
        command(**arguments, stated=FileFormat(**values, missing=missing))

    own = [parameter for parameter in signature.parameters.values() if parameter.name != "stated"]
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        for name, annotation in _OPTIONS.items()
    ]
    changed = signature.replace(parameters=[*own, *added])
    run.__signature__ = changed  # type: ignore[attr-defined] # which Typer reads
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in changed.parameters.values()}
    return run
