"""A diagnosis as an object for JSON; numbers that are not finite are null."""

from collections.abc import Mapping
from math import isfinite
from typing import Any

from reactorwatch.diagnosis.difference import Difference
from reactorwatch.diagnosis.result import Cause, Diagnosis, Experiment, HeldOut, Law

_ESTIMATE = ("value", "sd", "unit")


def as_object(diagnosis: Diagnosis, file: str, seconds: float, zero: str | None = None) -> dict[str, Any]:
    """Object that `diagnose --json` prints.

    Args:
        diagnosis: diagnosis of the file.
        file: name of the file as given.
        seconds: duration of the diagnosis.
        zero: clock time from which the minutes count; None: not known.
    """
    experiment = diagnosis.experiment
    return {
        "file": file,
        "zero": zero,
        "samples": diagnosis.samples,
        "runs": diagnosis.runs,
        "span_min": _number(diagnosis.span_min),
        "seconds": _number(round(seconds, 3)),
        "verdict": diagnosis.verdict,
        "causes": [_cause(cause, diagnosis.runs) for cause in diagnosis.causes],
        "alternatives": [
            {
                "causes": [_cause(cause, diagnosis.runs) for cause in item.explanation],
                "delta_bic": _number(item.delta_bic),
            }
            for item in diagnosis.alternatives
        ],
        "location": diagnosis.location or None,
        "locations": [{"location": name, "delta_bic": _number(worse)} for name, worse in diagnosis.locations.items()],
        "law": None if diagnosis.law is None else _law(diagnosis.law),
        "significant": bool(diagnosis.significant),
        "practical": bool(diagnosis.practical),
        "gain": {
            "delta_bic": _number(diagnosis.gain.delta_bic),
            "held_out": _holdout_errors(diagnosis.gain.held_out),
        },
        "adequacy": {name: {"minus_log10_p": _number(value)} for name, value in diagnosis.adequacy.items()},
        "experiment": None if experiment is None else _experiment(experiment),
        "extended_model": diagnosis.extended_model,
        **({"parameters": _parameters(diagnosis)} if diagnosis.parameters else {}),
    }


def _holdout_errors(errors: Mapping[str, HeldOut]) -> dict[str, Any]:
    return {name: _fields(item, "rmse_before", "rmse_after", "noise_sd", "unit") for name, item in errors.items()}


def _law(law: Law) -> dict[str, Any]:
    return {
        **_fields(law, "location", "form", "formula", "term", "unit"),
        "variables": list(law.variables),
        "parameters": {name: _fields(item, *_ESTIMATE) for name, item in law.parameters.items()},
        "rivals": [_fields(item, "location", "form", "formula", "delta_bic") for item in law.rivals],
        "range": {name: [_number(end) for end in ends] for name, ends in law.range.items()},
        "held_out": _holdout_errors(law.held_out),
        "correlations": {
            name: {"parameter": other, "correlation": _number(value)}
            for name, (other, value) in law.correlations.items()
        },
    }


def _cause(cause: Cause, runs: int) -> dict[str, Any]:
    return {
        **_fields(cause, "cause", "profile", "label", "location"),
        **({"run": cause.run} if runs > 1 else {}),
        "parameters": {name: _fields(item, *_ESTIMATE) for name, item in cause.parameters.items()},
    }


def _parameters(diagnosis: Diagnosis) -> dict[str, Any]:
    """Uncertain parameters."""
    return {
        name: _fields(item, "nominal", "stated_sd") | _fields(item.estimate, *_ESTIMATE)
        for name, item in diagnosis.parameters.items()
    }


def report_object(diagnosis: Diagnosis, file: str, seconds: float, zero: str | None = None) -> dict[str, Any]:
    """Content of report.json: `as_object` plus the differences between simulation and record."""
    differences = {name: _difference(item) for name, item in diagnosis.differences.items()}
    return as_object(diagnosis, file, seconds, zero) | {"differences": differences}


def _experiment(experiment: Experiment) -> dict[str, Any]:
    return {
        "why": experiment.why,
        "input": [[_number(minute), _number(value)] for minute, value in experiment.input],
        "separates": list(experiment.separates),
        "signal": experiment.signal,
        "span_min": _number(experiment.span_min),
        "expected_delta_bic": _number(experiment.expected_delta_bic),
        "probability": _number(experiment.probability),
        "limits": {name: list(ends) for name, ends in experiment.limits.items()},
        "expected": [
            {
                "between": list(item.between),
                "delta_bic": _number(item.expected_delta_bic),
                "probability": _number(item.probability),
            }
            for item in experiment.separations
        ],
        "predicted": {
            label: {name: list(ends) for name, ends in ranges.items()} for label, ranges in experiment.predicted.items()
        },
    }


def _difference(item: Difference) -> dict[str, Any]:
    return {
        **_fields(item, "rmse", "noise_sd", "noise_share", "one_step", "unit"),
        "along": {
            axis: [
                {"from": part.lower, "to": part.upper, "mean": part.mean, "rmse": part.rmse, "rows": part.rows}
                for part in ranges
            ]
            for axis, ranges in item.along.items()
        },
    }


def _fields(item: object, *names: str) -> dict[str, Any]:
    """Texts and numbers of an object, by the names of its attributes."""
    values = {name: getattr(item, name) for name in names}
    return {name: value if isinstance(value, str) else _number(value) for name, value in values.items()}


def _number(value: float) -> float | None:
    return float(value) if isfinite(value) else None
