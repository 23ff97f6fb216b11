"""Files that pages of documentation take for granted, each made once for all pages."""

import shutil
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.three_tanks import EFFECTS as THREE_TANKS_EFFECTS
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.integration.watched_hour import record_hour

LEAK = "coolant_flow:step:-0.15@120min"
NARROW = {"kind": "random-steps", "low": 102.41, "high": 104.41}


def _record(path: Path) -> None:
    """A record with a leak after the time of a training."""
    write_table(path, simulate_record(PlantConfig(seed=3, faults=(LEAK,)), 1500))


def _renamed_record(path: Path) -> None:
    """The same with columns of other names."""
    _record(path)
    text = path.read_text(encoding="utf-8")
    header, rows = text.split("\n", 1)
    path.write_text(f"{header.replace('qc', 'FC-7').replace('T', 'TI-101')}\n{rows}", encoding="utf-8")


def _logged_record(path: Path, start: str = "2026-10-24T23:00:06+00:00") -> None:
    """The same as a logger in Germany writes it, over the end of summer time."""
    record = simulate_record(PlantConfig(seed=3, faults=(LEAK,)), 1500)
    zone, first = ZoneInfo("Europe/Berlin"), datetime.fromisoformat(start)
    lines = ["Anlage 7;;;", ";;;", "Zeit;FC-7;AI-3;TI-101", ";l/min;mol/l;K"]
    for minutes, *values in zip(record.time_min, *record.columns.values(), strict=True):
        time = (first + timedelta(minutes=round(minutes - record.time_min[0], 6))).astimezone(zone)
        cells = [f"{value:.6f}".replace(".", ",") for value in values]
        lines.append(";".join([f"{time:%d.%m.%Y %H:%M:%S}", *cells]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _later_record(path: Path) -> None:
    """The next file of that logger."""
    _logged_record(path, "2026-10-25T02:00:06+00:00")


def _exported_record(path: Path) -> None:
    """The same as a historian exports it: T each 6 s, qc when it has moved, C from the laboratory each 5 min."""
    record = simulate_record(PlantConfig(seed=3, faults=(LEAK,)), 1500)
    moved = np.flatnonzero(np.diff(record.columns["qc"], prepend=0.0))
    values = [
        (round(60 * record.time_min[row], 1), tag, record.columns[tag][row])
        for tag, rows in (("qc", moved.tolist()), ("T", range(1500)), ("C", range(3, 1500, 50)))
        for row in rows
    ]
    lines = ["time_s,tag,value", *(f"{time_s},{tag},{value:.6f}" for time_s, tag, value in sorted(values))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _narrow_record(path: Path) -> None:
    """A record whose input hardly moves, so that several causes explain it."""
    config = PlantConfig(seed=4, faults=("coolant_flow:constant:-0.02",), scenario=NARROW)
    write_table(path, simulate_record(config, 600))


def _tank_record(path: Path) -> None:
    """Two tanks whose lower outlet is clogged from the 30th minute on."""
    random = np.random.default_rng(1)
    time_min = np.arange(900) / 15
    u = np.repeat(random.uniform(1.5, 2.5, 30), 30)
    true = parse_fault("outlet_clogging:step:0.2@30min", TANK_EFFECTS).extend(tanks())
    true = true.with_values({"k1": 2.9})
    level = Simulator(true).run(time_min, u, np.array([4.0, 4.0])).outputs[:, 0]
    write_table(path, Record(time_min, {"u": u, "x2": level + random.normal(0.0, 0.01, level.size)}, path.name))


def _three_tanks_record(path: Path) -> None:
    """Three tanks whose pipe from tank 1 to tank 3 clogs, as a logger in Germany writes it, in units of its own."""
    random = np.random.default_rng(2)
    time_min = np.arange(400) * 4 / 60
    flows = np.array([21.37, 53.80]) + np.repeat(random.uniform(-8, 8, (20, 2)), 20, axis=0)
    true = parse_fault("clog13:ramp:0.3@8min,end=26min", THREE_TANKS_EFFECTS).extend(three_tanks())
    levels = Simulator(true).run(time_min, flows, np.array([41.0, 32.0, 36.6])).outputs
    levels += random.normal(0.0, 0.1, levels.shape)
    cells = np.column_stack([time_min * 60, flows * [3.6, 1.0], levels * [10.0, 1.0, 1.0]])
    lines = ["time;P101;P102;L1;L2;L3"]
    lines += [";".join(f"{value:.4f}".replace(".", ",") for value in row) for row in cells]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _temperature_lab(path: Path, seed: int = 1, lost: float = 0.0) -> None:
    """Two heaters and two temperatures a second for 15 min, as an Arduino's logger writes them.

    Written independently of the page's equations, in Euler steps of 0.1 s. From the tenth minute on heater 1 loses a
    share of its power.
    """
    random, rows = np.random.default_rng(seed), 900
    heaters = np.repeat(random.uniform(10.0, 70.0, (rows // 60, 2)), 60, axis=0).round(1)
    room, kelvin, measured = 296.15, np.array([296.15, 296.15]), np.empty((rows, 2))
    for row in range(rows):
        measured[row] = kelvin - 273.15
        power = heaters[row] * [0.01, 0.0075] * np.array([1.0 - lost * (row >= 600), 1.0])
        for _ in range(10):
            radiated = 0.9 * 5.67e-8 * kelvin**4
            exchanged = 0.002 * (kelvin[1] - kelvin[0]) + 0.0002 * (radiated[1] - radiated[0])
            lost_to_room = 0.01 * (kelvin - room) + 0.001 * (radiated - 0.9 * 5.67e-8 * room**4)
            kelvin = kelvin + 0.1 * (power - lost_to_room + exchanged * np.array([1.0, -1.0])) / 2.0
    measured += random.normal(0.0, 0.05, measured.shape)
    table = np.column_stack([np.arange(rows), heaters, measured])
    header = "Time (sec), Heater 1 (%), Heater 2 (%), Temperature 1 (degC), Temperature 2 (degC)"
    np.savetxt(path, table, fmt="%.3f", delimiter=",", header=header, comments="")


def _later_temperature_lab(path: Path) -> None:
    """The same lab on another day: heater 1 loses a fifth of its power."""
    _temperature_lab(path, 2, 0.2)


def _recording(path: Path) -> None:
    """An hour of a plant, recorded with all that its monitor published."""
    record_hour(path, black_box_min=0.0).stop()


def _records(folder: Path) -> None:
    """Two short records of sound plants."""
    folder.mkdir()
    for seed in range(2):
        write_table(folder / f"{seed}.csv", simulate_record(PlantConfig(seed=seed), 250))


GIVEN: dict[str, Callable[[Path], None]] = {
    "record.csv": _record,
    "plant.csv": _renamed_record,
    "plant.txt": _logged_record,
    "later.txt": _later_record,
    "export.csv": _exported_record,
    "narrow.csv": _narrow_record,
    "rig.csv": _tank_record,
    "tanks.txt": _three_tanks_record,
    "tclab.csv": _temperature_lab,
    "tclab_later.csv": _later_temperature_lab,
    "run.mcap": _recording,
    "records": _records,
}
"""How each is made, by its name on the pages."""


class Files:
    """Gives copies of what is made once.

    Args:
        folder: where the first copy of each is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def give(self, name: str, folder: Path) -> None:
        """Put a file or a folder of a page into that page's folder."""
        made = self._folder / name
        if not made.exists():
            GIVEN[name](made)
        if made.is_dir():
            shutil.copytree(made, folder / name)
        else:
            shutil.copy(made, folder / name)
