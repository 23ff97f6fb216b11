"""Watches a process plant as it runs, and explains it when it misbehaves.

The public names are those of `reactorwatch.api`. They are imported when they are first used: the command needs few of
them to answer.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reactorwatch.api import Monitor, backtest, diagnose, effects, identify, processes, read_record, simulate
    from reactorwatch.errors import InputError
    from reactorwatch.process.model import ProcessModel
    from reactorwatch.records.record import Record
    from reactorwatch.spc.charts import catalogue as charts

__version__ = "0.1.0"

__all__ = [
    "InputError",
    "Monitor",
    "ProcessModel",
    "Record",
    "backtest",
    "charts",
    "diagnose",
    "effects",
    "identify",
    "processes",
    "read_record",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module("reactorwatch.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
