"""Watches a process plant as it runs, and explains it when it misbehaves.

The public names are imported when they are first used: the command needs few of them to answer.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reactorwatch.api.backtest import backtest
    from reactorwatch.api.diagnosis import diagnose
    from reactorwatch.api.identification import identify
    from reactorwatch.api.monitor import Monitor
    from reactorwatch.api.records import Record, effects, processes, read_record
    from reactorwatch.api.simulation import simulate
    from reactorwatch.description.process import Process, Signal
    from reactorwatch.errors import InputError
    from reactorwatch.process.effect import Effect
    from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
    from reactorwatch.process.operation import Controller
    from reactorwatch.spc.charts import catalogue as charts

    __version__: str

_MODULES = {
    "Controller": "reactorwatch.process.operation",
    "Effect": "reactorwatch.process.effect",
    "InputError": "reactorwatch.errors",
    "Monitor": "reactorwatch.api.monitor",
    "Output": "reactorwatch.process.model",
    "Place": "reactorwatch.process.model",
    "Process": "reactorwatch.description.process",
    "ProcessModel": "reactorwatch.process.model",
    "Record": "reactorwatch.api.records",
    "Signal": "reactorwatch.description.process",
    "backtest": "reactorwatch.api.backtest",
    "charts": "reactorwatch.spc.charts.catalogue",
    "diagnose": "reactorwatch.api.diagnosis",
    "effects": "reactorwatch.api.records",
    "identify": "reactorwatch.api.identification",
    "new_clock": "reactorwatch.process.model",
    "parameter": "reactorwatch.process.model",
    "processes": "reactorwatch.api.records",
    "read_record": "reactorwatch.api.records",
    "simulate": "reactorwatch.api.simulation",
    "variable": "reactorwatch.process.model",
}
"""Modules of the public names; `charts` is one itself."""

__all__ = [
    "Controller",
    "Effect",
    "InputError",
    "Monitor",
    "Output",
    "Place",
    "Process",
    "ProcessModel",
    "Record",
    "Signal",
    "backtest",
    "charts",
    "diagnose",
    "effects",
    "identify",
    "new_clock",
    "parameter",
    "processes",
    "read_record",
    "simulate",
    "variable",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("reactorwatch.version").version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_MODULES[name])
    return module if name == "charts" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
