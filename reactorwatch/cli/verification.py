"""`replay --verify`: a recording through the monitor's core, and what it says held against what was recorded."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.replay.message_diff import Difference
from monitor_node.replay.verification import COMPARED, Verification, verify
from reactorwatch import __version__
from reactorwatch.cli.printing import say_text
from reactorwatch.cli.progress import task
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.errors import InputError
from reactorwatch.records.record import clock_time, to_minutes
from reactorwatch.runtime.config import parse_toml, read_settings, section
from reactorwatch.terminal import printable_lines
from recorder.tools.inspect import gaps_in, zero_ns_of
from recorder.tools.mcap_file import has_clock, one_plant_in, read_messages, read_metadata

SETTINGS = "settings"
"""What our metadata of a recording calls the settings of the nodes that ran."""
MOST_LINES = 10
LONGEST_VALUE = 60


def run(file: Path, config: Path | None, plant: str | None, *, as_json: bool) -> int:
    """Verify a recording and print what came of it.

    Args:
        file: the recording, or a folder of them.
        config: settings file; None: those in the recording.
        plant: whose monitor; may be left out if there is but one.
        as_json: whether one JSON object is printed, for machines.

    Returns:
        The exit code: 0 if everything is said again as it was recorded, 1 if not.

    Raises:
        InputError: it cannot be read, or nothing in it can be verified.
    """
    if file.suffix.lower() == ".csv":
        raise InputError(f"{file}: holds no alarms to verify; a recording (.mcap) was expected")
    metadata = read_metadata(file)
    monitor = _settings(file, metadata, config, one_plant_in(file, plant))

    def read() -> Iterator[Encoded]:
        return (Encoded(*entry[:4]) for entry in read_messages(file, plant=monitor.plant) if not entry.repeated)

    with task(f"verifying {file.name}"):
        try:
            found = verify(read, monitor)
        except InputError as error:
            raise error if str(error).startswith(str(file)) else InputError(f"{file}: {error}") from error
    version = metadata.get("version", __version__)
    if version != __version__:
        found.notes.append(f"it was recorded by version {version}, and this is {__version__}")
    found.notes += [
        f"{gap.messages} messages of {gap.stream} never reached this recording; what the monitor said of them, "
        "and what it learned from them, is then not said again"
        for gap in gaps_in(file)
        if gap.stream in {keys.all_of(monitor.plant, kind).removesuffix("/**") for kind in (keys.SAMPLE, *COMPARED)}
    ]
    zero_ns = zero_ns_of(file)
    said = _object(found, file, monitor.plant, zero_ns) | {"zero": clock_time(zero_ns) if has_clock(metadata) else None}
    say_text(msgspec.json.encode(said).decode() if as_json else _text(said))
    return 0 if found.exact else 1


def _settings(file: Path, metadata: dict[str, str], config: Path | None, plant: str) -> MonitorConfig:
    """How the monitor was set when this was recorded.

    Raises:
        InputError: nobody says.
    """
    if config is not None:
        tables = read_settings(config)
    elif SETTINGS in metadata:
        try:
            tables = parse_toml(metadata[SETTINGS].encode())
        except InputError as error:
            raise InputError(f"{file}: its metadata's settings: {error}") from error
    else:
        raise InputError(
            f"{file}: does not say how the monitor was set; name the settings file that it ran with by --config"
        )
    return section(MonitorConfig, "monitor", tables, {"plant": plant})


def _object(found: Verification, file: Path, plant: str, zero_ns: int) -> dict[str, Any]:
    counts = found.diff.counts
    return {
        "file": str(file),
        "plant": plant,
        "exact": found.exact,
        "rows": found.rows,
        "from_min": to_minutes(found.first_ns, zero_ns),
        "compared": sum(count.recorded for count in counts.values()),
        "kinds": [
            {"kind": kind, "recorded": count.recorded, "equal": count.equal} for kind, count in sorted(counts.items())
        ],
        "differing": found.diff.differing,
        "differences": [_difference(item, zero_ns) for item in found.diff.differences],
        "after_the_end": found.diff.unrecorded,
        "notes": found.notes,
    }


def _difference(item: Difference, zero_ns: int) -> dict[str, Any]:
    return {
        "topic": item.key,
        "at_min": to_minutes(item.time_ns, zero_ns),
        "what": item.what,
        "recorded": item.recorded,
        "again": item.again,
    }


def _text(said: dict[str, Any]) -> str:
    lines = [f"{said['file']}: {said['rows']} rows from {said['from_min']:g} min on, through the monitor's core again"]
    lines.append(f"  {'':16s} {'recorded':>9s} {'equal':>9s}")
    lines += [f"  {item['kind']:16s} {item['recorded']:9d} {item['equal']:9d}" for item in said["kinds"]]
    if said["exact"]:
        lines.append(f"all {said['compared']} are said again, value for value")
    else:
        lines.append(f"{said['differing']} DIFFER:")
    for item in said["differences"][:MOST_LINES]:
        values = f": recorded {_short(item['recorded'])}, again {_short(item['again'])}"
        told = item["what"] + (values if item["recorded"] and item["again"] else "")
        lines.append(f"  {item['at_min']:9.4g} min  {item['topic']}: {told}")
    if said["differing"] > MOST_LINES:
        lines.append(f"  and {said['differing'] - MOST_LINES} more (--json tells the first hundred)")
    if said["after_the_end"]:
        lines.append(f"{said['after_the_end']} more would have come after the end of the recording")
    lines += [f"note: {note}" for note in said["notes"]]
    return printable_lines(lines)


def _short(text: str) -> str:
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"
