"""A diagnosis as an object for JSON; numbers that are not finite are null."""

from collections.abc import Mapping
from math import isfinite
from types import MappingProxyType
from typing import Any

from reactorwatch.diagnosis.difference import Difference, Range
from reactorwatch.diagnosis.result import (
    AdjustedParameter,
    Alternative,
    Cause,
    Diagnosis,
    Estimate,
    Experiment,
    Gain,
    HeldOut,
    Law,
    RivalLaw,
    Separation,
)

_KEYS: Mapping[type, tuple[str, ...]] = MappingProxyType(
    {
        AdjustedParameter: ("nominal", "stated_sd"),
        Alternative: ("causes=explanation", "delta_bic"),
        Cause: ("cause", "profile", "label", "location", "run", "parameters"),
        Difference: ("rmse", "noise_sd", "noise_share", "one_step", "unit", "along"),
        Estimate: ("value", "sd", "unit"),
        Experiment: (
            *("why", "input", "separates", "signal", "span_min", "expected_delta_bic", "probability", "limits"),
            *("expected=separations", "predicted"),
        ),
        Gain: ("delta_bic", "held_out"),
        HeldOut: ("rmse_before", "rmse_after", "noise_sd", "unit"),
        Law: (
            *("location", "form", "formula", "term", "unit", "variables", "parameters", "rivals", "range"),
            *("held_out",),
        ),
        Range: ("from=lower", "to=upper", "mean", "rmse", "rows"),
        RivalLaw: ("location", "form", "formula", "delta_bic"),
        Separation: ("between", "delta_bic=expected_delta_bic", "probability"),
    }
)
"""Keys of each object in order; `key=attribute` where the attribute has another name."""


def as_object(diagnosis: Diagnosis, file: str, seconds: float, zero: str | None = None) -> dict[str, Any]:
    """Object that `diagnose --json` prints.

    Args:
        diagnosis: diagnosis of the file.
        file: name of the file as given.
        seconds: duration of the diagnosis.
        zero: clock time from which the minutes count; None: not known.
    """
    values = {
        "file": file,
        "zero": zero,
        "samples": diagnosis.samples,
        "runs": diagnosis.runs,
        "span_min": diagnosis.span_min,
        "seconds": round(seconds, 3),
        "verdict": diagnosis.verdict,
        "causes": diagnosis.causes,
        "alternatives": diagnosis.alternatives,
        "location": diagnosis.location or None,
        "locations": [{"location": name, "delta_bic": worse} for name, worse in diagnosis.locations.items()],
        "law": diagnosis.law,
        "significant": bool(diagnosis.significant),
        "practical": bool(diagnosis.practical),
        "gain": diagnosis.gain,
        "adequacy": {name: {"minus_log10_p": value} for name, value in diagnosis.adequacy.items()},
        "experiment": diagnosis.experiment,
    }
    result: dict[str, Any] = _plain(values) | {"extended_model": diagnosis.extended_model}
    if diagnosis.runs == 1:
        for cause in (*result["causes"], *(cause for item in result["alternatives"] for cause in item["causes"])):
            del cause["run"]
    if diagnosis.parameters:
        result["parameters"] = {
            name: _plain(item) | _plain(item.estimate) for name, item in diagnosis.parameters.items()
        }
    return result


def report_object(diagnosis: Diagnosis, file: str, seconds: float, zero: str | None = None) -> dict[str, Any]:
    """Content of report.json: `as_object` plus the differences between simulation and record."""
    return as_object(diagnosis, file, seconds, zero) | {"differences": _plain(diagnosis.differences)}


def _plain(value: Any) -> Any:
    """Convert to what JSON has."""
    if isinstance(value, float):
        return float(value) if isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if type(value) not in _KEYS:
        return value
    keys = (key.partition("=") for key in _KEYS[type(value)])
    result = {key: _plain(getattr(value, attribute or key)) for key, _, attribute in keys}
    if isinstance(value, Law):
        result["correlations"] = {
            name: {"parameter": other, "correlation": _plain(number)}
            for name, (other, number) in value.correlations.items()
        }
    return result
