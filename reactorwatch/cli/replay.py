"""`replay --verify`: run a recording through the monitor's core and compare the output with the recorded messages."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from monitor_node.config import MonitorConfig
from monitor_node.replay.message_diff import Difference
from monitor_node.replay.verification import COMPARED, Verification, verify
from reactorwatch.cli.display import json_line, print_lines, print_report, task
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.description.process import Process
from reactorwatch.description.read import ProcessChoice, find_in_catalogue, find_process
from reactorwatch.errors import InputError
from reactorwatch.records.decode import is_table
from reactorwatch.records.record import format_utc, to_minutes
from reactorwatch.runtime.config import parse_tables, read_settings, section
from reactorwatch.version import UNKNOWN, describe_build, this_build
from recorder.files.recording import Recording, gaps_of, has_clock
from recorder.tools.inspect import zero_ns_of

SETTINGS = "settings"
"""Name of the nodes' settings in the metadata of a recording."""

MAX_LINES, MAX_VALUE = 10, 60  # differences, and letters of a value, that fit a terminal


def run(file: Path, config: Path | None, plant: str | None, process: str | None = None, *, as_json: bool) -> int:
    """Verify a recording and print the result."""
    if is_table(file):
        raise InputError(f"{file}: holds no alarms to verify; a recording (.mcap) was expected")
    recording = Recording(file)
    metadata = recording.metadata
    other_builds = _describe_other_builds(recording)
    for line in other_builds:  # before the work, whose result or refusal it may explain
        print_lines(line, err=as_json)
    monitor = _settings(file, metadata, config, recording.one_plant(plant))
    judged = find_process(process, on_bus=True) if process else None
    if judged is None and config is None:
        judged = _recorded_process(recording, monitor)

    def read() -> Iterator[Encoded]:
        return (Encoded(*entry[:4]) for entry in recording.messages(plant=monitor.plant) if not entry.latched)

    with task(f"verifying {file.name}"):
        try:
            verification = verify(read, monitor, judged)
        except InputError as error:
            raise error if str(error).startswith(str(file)) else InputError(f"{file}: {error}") from error
    verification.notes += [
        f"{gap.messages} messages of {gap.stream} never reached this recording; what the monitor published about "
        "them, and what it learned from them, is then not reproduced"
        for gap in gaps_of(recording.metadata_records)
        if gap.stream in {keys.all_keys(monitor.plant, kind).removesuffix("/**") for kind in (keys.SAMPLE, *COMPARED)}
    ]
    zero_ns = zero_ns_of(recording)
    report = _object(verification, file, monitor.plant, zero_ns) | {
        "zero": format_utc(zero_ns) if has_clock(metadata) else None
    }
    if as_json:
        report["notes"] = other_builds + report["notes"]
    print_report(json_line(report) if as_json else _text(report), as_json=as_json)
    return 0 if verification.exact else 1


def _describe_other_builds(recording: Recording) -> list[str]:
    """Remark that other builds of this software made the recording, or files of it; empty if it was this one."""
    recorded = [{"version": UNKNOWN, "commit": UNKNOWN} | origin for origin in recording.metadata_by_file]
    builds = dict.fromkeys(describe_build(build["version"], build["commit"]) for build in recorded)
    others = [build for build in builds if build != this_build()]
    if not others:
        return []
    return [f"it was recorded by another build, {' and '.join(others)}, and this is {this_build()}: they may differ"]


def _recorded_process(recording: Recording, monitor: MonitorConfig) -> Process | None:
    """Process that the settings in a recording name: of the catalogue, or as the recording itself describes it.

    A file that they name is not opened. None: they name none.
    """
    path = ProcessChoice(monitor.process).file
    described = None if path is None else recording.process(monitor.plant)
    if path is not None and described is not None and (described.model is not None or path.suffix.lower() == ".toml"):
        return described
    return find_in_catalogue(monitor.process, str(recording.path)) if monitor.process else None


def _settings(file: Path, metadata: dict[str, str], config: Path | None, plant: str) -> MonitorConfig:
    """Settings of the monitor when this was recorded."""
    if config is not None:
        tables = read_settings(config)
    elif SETTINGS in metadata:
        try:
            tables = parse_tables(metadata[SETTINGS].encode())
        except InputError as error:
            raise InputError(f"{file}: its metadata's settings: {error}") from error
    else:
        raise InputError(
            f"{file}: does not say how the monitor was set; name the settings file that it ran with by --config"
        )
    return section(MonitorConfig, "monitor", tables, {"plant": plant})


def _object(verification: Verification, file: Path, plant: str, zero_ns: int) -> dict[str, Any]:
    counts = verification.diff.counts
    return {
        "file": str(file),
        "plant": plant,
        "exact": verification.exact,
        "rows": verification.rows,
        "from_min": to_minutes(verification.first_ns, zero_ns),
        "compared": sum(count.recorded for count in counts.values()),
        "kinds": [
            {"kind": kind, "recorded": count.recorded, "equal": count.equal} for kind, count in sorted(counts.items())
        ],
        "differing": verification.diff.differing,
        "differences": [_difference(item, zero_ns) for item in verification.diff.differences],
        "after_the_end": verification.diff.unrecorded,
        "notes": verification.notes,
    }


def _difference(item: Difference, zero_ns: int) -> dict[str, Any]:
    return {
        "topic": item.key,
        "at_min": to_minutes(item.time_ns, zero_ns),
        "what": item.what,
        "recorded": item.recorded,
        "again": item.again,
    }


def _text(report: dict[str, Any]) -> str:
    lines = [
        f"{report['file']}: {report['rows']} rows from {report['from_min']:g} min on, through the monitor's core again"
    ]
    lines.append(f"  {'':16s} {'recorded':>9s} {'equal':>9s}")
    lines += [f"  {item['kind']:16s} {item['recorded']:9d} {item['equal']:9d}" for item in report["kinds"]]
    if report["exact"]:
        lines.append(f"all {report['compared']} are reproduced, value for value")
    else:
        lines.append(f"{report['differing']} DIFFER:")
    for item in report["differences"][:MAX_LINES]:
        values = f": recorded {_short(item['recorded'])}, again {_short(item['again'])}"
        text = item["what"] + (values if item["recorded"] and item["again"] else "")
        lines.append(f"  {item['at_min']:9.4g} min  {item['topic']}: {text}")
    if report["differing"] > MAX_LINES:
        lines.append(f"  and {report['differing'] - MAX_LINES} more (--json lists the first hundred)")
    if report["after_the_end"]:
        lines.append(f"{report['after_the_end']} more would have come after the end of the recording")
    lines += [f"note: {note}" for note in report["notes"]]
    return "\n".join(lines)


def _short(text: str) -> str:
    return text if len(text) <= MAX_VALUE else text[: MAX_VALUE - 1] + "…"
