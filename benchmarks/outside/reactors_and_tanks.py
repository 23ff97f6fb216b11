"""Three tanks, cascaded tanks and DaISy's reactor: diagnoses of a rig, and simulations along unseen rows.

Three tanks (DTS200): two inputs, three levels, closed loop; a fault from row 200 of 2,001. Each fault is diagnosed with
the whole catalogue, and again without its own cause and those that these sensors cannot tell from it: then it is
unknown and has to be placed at the right tank, pipe or pump. Data: zhuofupan/Three-Tank-System; the period is not
stated and taken as a second.

Cascaded tanks (Schoukens and Noel): a pump and two tanks, the upper one overflows; 1,024 rows, 4 s. The benchmark's
measure is the root mean square error of the simulation, whose state the first 50 rows may set. Where the folder has
one half alone, its first part is fitted and its second part is simulated.

DaISy 98-002: the stirred-tank reactor, 7,500 rows; the first half is fitted, the fit in percent is that of the
simulation of the second. Orders are chosen on the first half.
"""

import csv
import json
import re
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.outside.scores import Row, run
from reactorwatch.errors import InputError

TRUTH: dict[int, tuple[tuple[str, ...], tuple[str, ...]]] = {
    1: (("pump1", "pump2"), ("pump1", "pump2", "tank1", "tank2")),
    2: (("pump1", "leak1"), ("pump1", "tank1", "pipe13")),
    3: (("pump2", "leak2"), ("pump2", "tank2", "pipe32", "pipe20")),
    4: (("h1.bias",), ("h1", "tank1")),
    5: (("h2.bias",), ("h2", "tank2")),
    6: (("h3.bias",), ("h3", "tank3")),
    7: (("leak1", "pump1"), ("tank1", "pump1", "pipe13")),
    8: (("leak2", "pump2"), ("tank2", "pump2", "pipe32", "pipe20")),
    9: (("leak3",), ("tank3", "pipe13", "pipe32")),
    10: (("clog13",), ("pipe13", "tank1", "tank3")),
    11: (("clog20",), ("pipe20", "tank2")),
    12: (("clog32",), ("pipe32", "tank2", "tank3")),
}
"""Causes that count and places that count, by fault; tank 1's level is held, so a leak there and less from its pump
are the same to these sensors."""

_SIGNALS = {"Q1": "Q1_cm3_s", "Q2": "Q2_cm3_s", "h1": "h1_cm", "h2": "h2_cm", "h3": "h3_cm"}


def measure_faults(folder: Path, _seed: int) -> list[Row]:
    """Rows of the table, one for each fault in the folder."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        process = Path(temporary) / "rig.toml"
        process.write_text(describe_rig(), encoding="utf-8")
        for path in sorted(folder.glob("fault*.csv")):
            number = int(re.sub(r"\D", "", path.stem))
            causes, places = TRUTH[number]
            whole = _diagnose(path, process)
            withheld = _diagnose(path, process, *(option for cause in causes for option in ("--without", cause)))
            listed = {tuple(item["cause"] for item in each["causes"]) for each in whole["alternatives"]}
            listed.add(tuple(item["cause"] for item in whole["causes"]))
            hit = any(set(each) & set(causes) for each in listed)
            cells = {
                "verdict": whole["verdict"],
                "causes listed": "; ".join(sorted(" + ".join(each) for each in listed if each)) or "none",
                "truth among at most 3": "yes" if hit and len(listed) <= 3 else "no",
                "withheld": f"{withheld['verdict']} at {withheld['location']}",
                "right place": "yes" if withheld["verdict"] == "unknown" and withheld["location"] in places else "no",
            }
            rows.append(Row(f"fault {number}", "diagnose --process rig.toml", cells))
    return rows


def describe_rig() -> str:
    """Description of the three tanks as TOML, for the columns of the data."""
    signals = "".join(
        f'[[signals]]\nname = "{name}"\ncolumn = "{column}"\nrole = "{"input" if name[0] == "Q" else "output"}"\n'
        f'unit = "{"cm3/s" if name[0] == "Q" else "cm"}"\n'
        for name, column in _SIGNALS.items()
    )
    return f'name = "rig"\nequations = "three_tanks"\n[time]\ncolumn = "sample"\nunit = "s"\n{signals}'


def _diagnose(path: Path, process: Path, *options: str) -> dict:  # type: ignore[type-arg]
    found: dict = json.loads(run("diagnose", str(path), "--process", str(process), "--json", *options))  # type: ignore[type-arg]
    return found


MODELS = ("arx", "oe", "armax", "bj", "narx", "noe")
ORDERS = (1, 2, 3, 4)
SETTLE = 50
_UNCERTAIN = "[parameters]\n" + "".join(f"k{i} = {{ value = 3.0, sd = 1.5 }}\n" for i in (1, 2, 3, 4))
"""The constants of a rig are of this order; nothing more is known of them."""

_TANKS = ("--time-unit", "s", "--input", "pump_V", "--output", "level_V")


def measure_tanks(folder: Path, _seed: int) -> list[Row]:
    """Rows of the table of the cascaded tanks, one for each kind of model and one for the equations."""
    source = folder / "estimation.csv"
    with tempfile.TemporaryDirectory() as temporary:
        first, second = split(source, Path(temporary), 512)
        choose, judge = split(first, Path(temporary), 256)
        rows = []
        for model in MODELS:
            order = _best_order(choose, judge, model, SETTLE, *_TANKS)
            found = _identify(first, second, model, order, SETTLE, *_TANKS)
            error = found["rmse"]["free_run"] if found else float("inf")
            rows.append(
                Row(
                    f"reactorwatch identify, {model}",
                    f"order {order}, by its first half",
                    {"simulation, V": f"{error:.3f}"},
                )
            )
        rows.append(_equations(first, second, Path(temporary)))
    return rows


def _equations(first: Path, second: Path, folder: Path) -> Row:
    """Torricelli's equations with constants that are known to a half, and what `diagnose` adds to them."""
    process = folder / "rig.toml"
    process.write_text(_describe("cascaded_tanks") + _UNCERTAIN, encoding="utf-8")
    report = folder / "report"
    found = json.loads(run("diagnose", str(first), "--process", str(process), "-o", str(report), "--json"))
    named = " + ".join(item["cause"] for item in found["causes"]) or found["location"]
    process.write_text(_describe(str(report / "extended.json")), encoding="utf-8")
    out = folder / "simulated.csv"
    said = json.loads(
        run("simulate", str(second), "--process", str(process), "--settle", str(SETTLE), "-o", str(out), "--json")
    )
    error = said["rmse"]["x2"]["value"]
    return Row(
        "reactorwatch diagnose, equations, constants known to a half",
        f"{found['verdict']}: {named}",
        {"simulation, V": f"{error:.3f}"},
    )


def _describe(equations: str) -> str:
    """Description of the rig."""
    return (
        f'name = "rig"\nequations = "{equations}"\n[time]\ncolumn = "time_s"\nunit = "s"\n'
        '[[signals]]\nname = "u"\ncolumn = "pump_V"\nrole = "input"\nunit = "V"\n'
        '[[signals]]\nname = "x2"\ncolumn = "level_V"\nrole = "output"\nunit = "V"\n'
    )


def measure_reactor(file: Path, _seed: int) -> list[Row]:
    """Rows of the table of DaISy's reactor, one for each kind of model."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        first, second = split(file, Path(temporary), 3750)
        choose, judge = split(first, Path(temporary), 1875)
        for model in MODELS:
            cells, orders = {}, []
            for output in ("C", "T"):
                columns = ("--input", "qc", "--output", output)
                order = _best_order(choose, judge, model, 0, *columns)
                found = _identify(first, second, model, order, 0, *columns)
                cells[f"simulation of {output}, %"] = f"{found['fit_percent']['free_run']:.2f}" if found else "diverges"
                orders.append(f"{output}: {order}")
            rows.append(Row(f"reactorwatch identify, {model}", f"orders {', '.join(orders)}, by the first half", cells))
    return rows


def split(file: Path, folder: Path, rows: int) -> tuple[Path, Path]:
    """Split a CSV file after some rows; both parts have its header."""
    with file.open(encoding="utf-8", newline="") as lines:
        header, *data = csv.reader(lines)
    parts = []
    for name, part in (("a", data[:rows]), ("b", data[rows:])):
        path = folder / f"{file.stem}_{name}.csv"
        with path.open("w", encoding="utf-8", newline="") as out:
            csv.writer(out).writerows([header, *part])
        parts.append(path)
    return parts[0], parts[1]


def _best_order(fitted: Path, judged: Path, model: str, settle: int, *columns: str) -> int:
    """Order with the best simulation on rows that it was not fitted to."""
    fits = {}
    for order in ORDERS:
        found = _identify(fitted, judged, model, order, settle, *columns)
        fit = found["fit_percent"]["free_run"] if found else None
        fits[order] = float("-inf") if fit is None else fit
    return max(fits, key=lambda order: fits[order])


def _identify(fitted: Path, judged: Path, model: str, order: int, settle: int, *columns: str) -> dict[str, Any] | None:
    """JSON of `identify`; None where the rows do not determine this model."""
    try:
        said = run(
            "identify", str(fitted), "--validate", str(judged), "--settle", str(settle), "--model", model,
            "--order", str(order), "--json", *columns,
        )  # fmt: skip
    except InputError:
        return None
    found: dict[str, Any] = json.loads(said)
    return found
