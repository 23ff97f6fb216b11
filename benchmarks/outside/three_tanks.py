"""Three tanks (DTS200): two inputs, three levels, closed loop; a fault from row 200 of 2,001.

Each fault is diagnosed with the whole catalogue, and again without its own cause and those that these sensors cannot
tell from it: then it is unknown and has to be placed at the right tank, pipe or pump.
Data: zhuofupan/Three-Tank-System; the period is not stated and taken as a second.
"""

import json
import re
import tempfile
from pathlib import Path

from benchmarks.outside.scores import Row, run

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


def measure(folder: Path, _seed: int) -> list[Row]:
    """Rows of the table, one for each fault in the folder."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        process = Path(temporary) / "rig.toml"
        process.write_text(_description(), encoding="utf-8")
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


def _description() -> str:
    signals = "".join(
        f'[[signals]]\nname = "{name}"\ncolumn = "{column}"\nrole = "{"input" if name[0] == "Q" else "output"}"\n'
        f'unit = "{"cm3/s" if name[0] == "Q" else "cm"}"\n'
        for name, column in _SIGNALS.items()
    )
    return f'name = "rig"\nequations = "three_tanks"\n[time]\ncolumn = "sample"\nunit = "s"\n{signals}'


def _diagnose(path: Path, process: Path, *options: str) -> dict:  # type: ignore[type-arg]
    found: dict = json.loads(run("diagnose", str(path), "--process", str(process), "--json", *options))  # type: ignore[type-arg]
    return found
