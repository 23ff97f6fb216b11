"""Scores of diagnoses of inexact records, and their table.

An explanation is right if it names the true cause and nothing beside it. Explanations come in the order in which
`diagnose --json` lists them: `causes`, `alternatives`, and, unless the model is called right, `nearest`.

- *First*: the first one is right. *Listed*: any one is.
- *Leads*: the first cause of the first one is the true cause, whatever is named beside it.
- Size and onset are those of the first right explanation; where none is right, both are wrong.

A cause is claimed if the verdict names one and the difference matters in practice, or if the grade says that causes
explain it.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.harness.study import markdown, percent

WITHIN, WITHIN_ROWS = 0.05, 2.0
"""Errors of sizes and onsets that are asked for."""

Json = Mapping[str, Any]


def explanations_of(found: Json) -> list[Sequence[Json]]:
    """Explanations in the order of the list, each as the causes in it."""
    listed = [found["causes"]] if found["causes"] else []
    nearest = [] if found["verdict"] == "nominal" else found.get("nearest", [])
    return [*listed, *(item.get("causes", [item]) for item in (*found["alternatives"], *nearest))]


def is_claimed(found: Json) -> bool:
    """True if the diagnosis claims a cause that matters in practice."""
    named = found["verdict"] in ("named", "ambiguous") and found["practical"]
    return bool(named or found.get("grade") in ("explained", "mostly"))


def score(truth: Json, found: Json) -> dict[str, Any]:
    """Score a diagnosis beside the truth of its record."""
    listed = explanations_of(found)
    result: dict[str, Any] = {
        "verdict": found["verdict"],
        "grade": found.get("grade"),
        "named": [" + ".join(item["cause"] for item in each) for each in listed],
        "claimed": is_claimed(found),
    }
    cause = truth["cause"]
    if cause is None:
        return result
    right = [each[0] for each in listed if len(each) == 1 and each[0]["cause"] in cause["names"]]
    result["first"] = bool(right) and listed[0][0] is right[0]
    result["leads"] = bool(listed) and listed[0][0]["cause"] in cause["names"]
    result["listed"] = bool(right)
    parameters = right[0].get("parameters", {}) if right else {}
    if cause["profile"] in ("step", "constant", "ramp"):
        size = parameters.get("size")
        result["size_error"] = min(abs(size["value"] / true - 1.0) for true in cause["sizes"]) if size else None
    if cause["onset_min"] is not None:
        onset = parameters.get("onset") or (found.get("onset") if right else None)
        error_min = abs(onset["value"] - cause["onset_min"]) if onset else None
        result["onset_error_rows"] = None if error_min is None else error_min / truth["period_min"]
    return result


def failed_score(truth: Json, reason: str) -> dict[str, Any]:
    """Score of a diagnosis that ended with an error: nothing is named."""
    nothing = {"verdict": "error", "causes": [], "alternatives": [], "practical": False}
    return score(truth, nothing) | {"error": reason}


def share(values: Iterable[bool]) -> str:
    """A share in percent with its exact 95 % interval, a dash for none."""
    flags = list(values)
    return percent(sum(flags), len(flags)) if flags else "–"


def table(results: Sequence[Json]) -> str:
    """A row for each class of records with a cause, one for all of them, and one for the sound ones."""
    hidden = [item for item in results if item["truth"]["cause"] is not None]
    groups = {group: [item for item in hidden if _group(item) == group] for group in dict.fromkeys(map(_group, hidden))}
    groups |= {"all with a cause": hidden, "sound": [item for item in results if item["truth"]["cause"] is None]}
    rows = []
    for name, members in groups.items():
        scores = [item["score"] for item in members]
        seconds = [item["cpu_s"] for item in members]
        cells = [
            share(item["first"] for item in scores if "first" in item),
            share(item["leads"] for item in scores if "leads" in item),
            share(item["listed"] for item in scores if "listed" in item),
            share(_is_within(item["size_error"], WITHIN) for item in scores if "size_error" in item),
            share(_is_within(item["onset_error_rows"], WITHIN_ROWS) for item in scores if "onset_error_rows" in item),
            share(item["claimed"] for item in scores),
            f"{np.median(seconds):.1f} / {max(seconds):.1f}" if seconds else "–",
            str(sum("error" in item for item in scores)),
        ]
        rows.append([name, str(len(members)), *cells])
    heading = [
        "records",
        "n",
        "first",
        "leads",
        "listed",
        f"size within {WITHIN:.0%}",
        f"onset within {WITHIN_ROWS:g} rows",
    ]
    return markdown([*heading, "a cause claimed", "CPU s, median / most", "errors"], rows)


def _is_within(error: float | None, limit: float) -> bool:
    return error is not None and error <= limit


def _group(result: Json) -> str:
    return str(result["truth"]["class"])
