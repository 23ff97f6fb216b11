"""Tennessee Eastman: faults of a simulated chemical plant with 52 signals, a row every 3 minutes.

Protocol: learn from d00 alone (500 sound rows), all columns; a fault sets in at row 160 of the 960 of its file.
Detection is the share of the rows from 160 on that are in alarm; false alarms are that of d00_te and of all rows
before 160.
Data: camaramm/tennessee-eastman-profBraatz; Russell, Chiang and Braatz (2000).
"""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.outside.peers import PEERS, Array, cross_validated_limits, smooth
from benchmarks.outside.scores import Flags, Row, WatchedRows, backtest, blocks_of, bootstrap_interval

ONSET = 160
SIGNALS, MEASURED = 52, 41
PERIOD_MIN = 3.0
CHART = "residual_space"
LEVEL = 0.99
HARD = ("03", "09", "15")
"""Faults that leave hardly a trace; means are without them."""
PLACES = {
    "01": ("feed of A, stream 4", ("XMEAS1", "XMV3", "XMEAS4")),
    "04": ("reactor's cooling water", ("XMV10", "XMEAS9", "XMEAS21")),
    "05": ("condenser's cooling water", ("XMEAS22", "XMV11")),
    "11": ("reactor's cooling water", ("XMV10", "XMEAS9", "XMEAS21")),
}
"""Faults whose place Russell, Chiang and Braatz (2000) describe, with the signals next to it."""

RECORDS = (
    "Each column of a fault is one record; the mean is over one record of each fault but 3, 9 and 15, and its interval "
    "over blocks of these records, not over other records. Over seven fresh seeds of the original simulator "
    "`reactorwatch` detects fault 15 in 0.04 of the rows."
)
"""Records that the numbers of `measure` are from; the seeds were simulated apart from this benchmark."""

_BLOCK = 40
_WEIGHT = 0.3


def rows_of(file: Path) -> Array:
    """Values of a file, shape (rows, 52); d00 has a line for each signal."""
    values = np.loadtxt(file)
    return values.T if values.shape[0] == SIGNALS else values


def measure(folder: Path, seed: int) -> list[Row]:
    """Rows of the table, one for each method."""
    train, sound = folder / "d00.dat", folder / "d00_te.dat"
    faults = {re.sub(r"\D", "", path.stem): path for path in sorted(folder.glob("d[0-9][0-9]_te.dat")) if path != sound}
    files = [sound, *faults.values()]
    names = [sound.stem, *faults]
    watched, promised = _monitor(train, files)
    rows = [
        _score(
            "reactorwatch", "backtest --train d00.dat, no settings", names, [item.in_alarm for item in watched], seed
        )
    ]
    sound_rows = [np.flatnonzero(item.raised[: None if i == 0 else ONSET]).size for i, item in enumerate(watched)]
    rows[0].cells["alarms while sound"] = f"{sum(sound_rows)} ({promised:.2g} promised)"
    training = rows_of(train)
    for name, peer in PEERS.items():
        model = peer.fit(training)
        textbook, validated = model.textbook_limits(LEVEL), cross_validated_limits(peer, training, LEVEL)
        values = [model.statistics(rows_of(file)) for file in files]
        for statistic in validated:
            for kind, limits in (("textbook limit", textbook), ("blocked cross-validation", validated)):
                if statistic in limits:
                    out = [item[statistic] > limits[statistic] for item in values]
                    rows.append(_score(f"{name} {statistic}", kind, names, out, seed))
    rows.append(_score("CVA Tr2, EWMA", "blocked cross-validation", names, _smooth_variates(training, files), seed))
    return rows


def measure_places(folder: Path, seed: int) -> list[Row]:
    """Signals that the first alarm with a place names, for the faults whose place is known."""
    files = {name: folder / f"d{name}_te.dat" for name in PLACES}
    files = {name: file for name, file in files.items() if file.exists()}
    objects = _watch(folder / "d00.dat", list(files.values()))[1]
    rows = []
    for name, found in zip(files, objects, strict=True):
        place, signals = PLACES[name]
        placed = [item for item in found["alarms"] if item["suspect"] and item["alarm"].startswith(CHART)]
        placed = [item for item in placed if item["raised_min"] >= ONSET * PERIOD_MIN]
        named = [item["cause"] for item in placed[0]["suspect"]] if placed else []
        cells = {
            "place": f"{place}: {', '.join(signals)}",
            "named": ", ".join(named),
            "after, rows": f"{placed[0]['raised_min'] / PERIOD_MIN - ONSET:.0f}" if placed else "",
            "among the first three": "yes" if set(named) & set(signals) else "no",
        }
        rows.append(Row(f"fault {int(name)}", "backtest --train d00.dat, no settings", cells))
    return rows


def _monitor(train: Path, files: list[Path]) -> tuple[list[WatchedRows], float]:
    """Rows of the files, and the number of false alarms promised in the sound ones."""
    watched, objects = _watch(train, files)
    per_row = objects[0]["expected_false_alarms"] / objects[0]["samples"]
    return watched, per_row * (watched[0].in_alarm.size + ONSET * (len(files) - 1))


def _watch(train: Path, files: list[Path]) -> tuple[list[WatchedRows], list[dict[str, Any]]]:
    with tempfile.TemporaryDirectory() as temporary:
        process = Path(temporary) / "tennessee.toml"
        process.write_text(_description(), encoding="utf-8")
        return backtest(files, Path(temporary), "--process", str(process), "--train", str(train))


def _description() -> str:
    names = [f"XMEAS{n}" for n in range(1, MEASURED + 1)] + [f"XMV{n}" for n in range(1, SIGNALS - MEASURED + 1)]
    signals = "".join(
        f'[[signals]]\nname = "{name}"\ncolumn = {column}\nrole = "output"\n' for column, name in enumerate(names, 1)
    )
    return f'name = "tennessee"\n[time]\nperiod = "3 min"\n[file]\nheader = false\n{signals}'


def _smooth_variates(training: Array, files: list[Path]) -> list[Flags]:
    """EWMA of CVA's Tr2, its limit from blocks of the training judged by the others."""
    peer = PEERS["CVA"]
    held_out = cross_validated_limits(peer, training, LEVEL, transform=_ewma)["Tr2"]
    model = peer.fit(training)
    return [_ewma(model.statistics(rows_of(file))["Tr2"]) > held_out for file in files]


def _ewma(values: Array) -> Array:
    return smooth(values, _WEIGHT)


def _score(method: str, limits: str, names: list[str], out: list[Flags], seed: int) -> Row:
    rng = np.random.default_rng(seed)
    sound, faulty = out[0], dict(zip(names[1:], out[1:], strict=True))
    before = np.concatenate([sound, *(flags[:ONSET] for flags in faulty.values())])
    shares = {name: float(flags[ONSET:].mean()) for name, flags in faulty.items()}
    seen = [name for name in shares if name not in HARD]
    blocks = np.array(
        [np.mean(item) for item in zip(*(blocks_of(faulty[name][ONSET:], _BLOCK) for name in seen), strict=True)]
    )
    cells = {
        "mean detection": f"{np.mean([shares[name] for name in seen]):.3f}",
        "95 % interval": "{:.3f} to {:.3f}".format(*bootstrap_interval(blocks, rng)),
        "rows in alarm while sound": f"{100 * before.mean():.2f} %",
        **{f"fault {int(name)}, one record": f"{share:.2f}" for name, share in shares.items()},
    }
    return Row(method, limits, cells)
