"""Scores of diagnoses of inexact records, and their table.

An explanation is right if it names the true cause and nothing beside it. Explanations come in the order in which
`diagnose --json` lists them: `causes`, `alternatives`, and, unless the model is called right, `nearest`.

- *First*: the first one is right. *Listed*: any one is.
- *Leads*: the first cause of the first one is the true cause, whatever is named beside it.
- *Size* and *onset*: those of the first right explanation are close to the truth; where none is right, both are wrong.
- *Suspects* are scored by their order alone, `unknown` among them.
- *Claimed*: the verdict names a cause and the difference matters in practice, or the grade says that causes explain it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.harness.study import markdown, percent

COLUMNS = {"first": "first", "leads": "leads", "listed": "listed"} | {
    "size": "size within 5 %",
    "onset": "onset within 2 rows",
    "claimed": "a cause claimed",
}

SUSPECTS = {"first": "first", "among_three": "among three", "unknown": "unknown first"}

Json = Mapping[str, Any]


def explanations_of(found: Json) -> list[Sequence[Json]]:
    """Explanations in the order of the list, each as the causes in it."""
    listed = [found["causes"]] if found["causes"] else []
    nearest = [] if found["verdict"] == "nominal" else found.get("nearest", [])
    return [*listed, *(item.get("causes", [item]) for item in (*found["alternatives"], *nearest))]


def score(truth: Json, found: Json) -> dict[str, Any]:
    """Score a diagnosis beside the truth of its record; an error is None where nothing is stated."""
    listed, cause = explanations_of(found), truth["cause"]
    named = found["verdict"] in ("named", "ambiguous") and found["practical"]
    result: dict[str, Any] = {
        "verdict": found["verdict"],
        "grade": found.get("grade"),
        "named": [" + ".join(item["cause"] for item in each) for each in listed],
        "claimed": bool(named or found.get("grade") in ("explained", "mostly")),
    }
    if cause is None:
        return result
    right = [each[0] for each in listed if len(each) == 1 and each[0]["cause"] in cause["names"]]
    result["first"] = bool(right) and listed[0][0] is right[0]
    result["leads"] = bool(listed) and listed[0][0]["cause"] in cause["names"]
    result["listed"] = bool(right)
    parameters = right[0].get("parameters", {}) if right else {}
    if cause["profile"] not in ("free", "pulses"):
        size = parameters.get("size")
        error = min(abs(size["value"] / true - 1.0) for true in cause["sizes"]) if size else None
        result |= {"size_error": error, "size": error is not None and error <= 0.05}
    if cause["onset_min"] is not None:
        onset = parameters.get("onset") or (found.get("onset") if right else None)
        error = abs(onset["value"] - cause["onset_min"]) / truth["period_min"] if onset else None
        result |= {"onset_error_rows": error, "onset": error is not None and error <= 2.0}
    return result


def score_suspects(truth: Json, suspects: Sequence[Json]) -> dict[str, Any]:
    """Score the suspects of an alarm, the likeliest first."""
    named = [item["cause"] for item in suspects]
    right = [name in truth["cause"]["names"] for name in named]
    return {
        "named": named,
        "probabilities": [item["probability"] for item in suspects],
        "first": any(right[:1]),
        "among_three": any(right[:3]),
        "unknown": named[:1] == ["unknown"],
    }


def table(results: Sequence[Json], columns: Mapping[str, str] = COLUMNS) -> str:
    """A row for each class of records with a cause, one for all of them, and one for the sound ones."""
    hidden = [item for item in results if item["truth"]["cause"] is not None]
    groups: dict[str, list[Json]] = {}
    for item in hidden:
        groups.setdefault(item["truth"]["group"], []).append(item)
    groups |= {"all with a cause": hidden, "sound": [item for item in results if item["truth"]["cause"] is None]}
    rows = []
    for name, members in groups.items():
        shares = [_share([item["score"][key] for item in members if key in item["score"]]) for key in columns]
        seconds = [item["cpu_s"] for item in members] or [0.0]
        errors = sum("error" in item["score"] for item in members)
        rows.append([name, str(len(members)), *shares, f"{np.median(seconds):.1f} / {max(seconds):.1f}", str(errors)])
    return markdown(["records", "n", *columns.values(), "CPU s, median / most", "errors"], rows)


def _share(flags: Sequence[bool]) -> str:
    return percent(sum(flags), len(flags)) if flags else "–"
