"""Output of `info` and `recover`: a JSON object, or lines for people."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from reactorwatch.description.process import ROLES, Process
from reactorwatch.records.record import Record, format_utc, to_minutes
from reactorwatch.sentences.alarm import format_moment, priority_word
from reactorwatch.terminal import printable_lines
from recorder.files.copies import RecoveryResult
from recorder.files.recording import has_clock
from recorder.tools.inspect import FileInfo

GAP = 1.5
"""Steps of at least so many median steps are gaps."""

MAX_LINES = 20
"""Gaps that are listed one by one for people."""


def table_object(record: Record, file: Path) -> dict[str, Any]:
    """The object that `info --json` prints for a table."""
    steps = [np.diff(run.time_min) for run in record.split_runs()]
    step_min = float(np.median(np.concatenate(steps))) if record.rows > len(steps) else None
    gaps = []
    for run, between in zip(record.split_runs(), steps, strict=True):
        rows = np.flatnonzero(between > GAP * step_min) if step_min is not None else ()
        gaps += [{"from_min": float(run.time_min[row]), "to_min": float(run.time_min[row + 1])} for row in rows]
    return {
        "file": str(file),
        "zero": record.zero,
        "read_as": record.read_as,
        "rows": record.rows,
        "runs": len(record.run_starts),
        "first_min": float(record.time_min[0]),
        "last_min": float(record.time_min[-1]),
        "period_s": None if step_min is None else step_min * 60,
        "gaps": gaps,
        "signals": {name: _signal_object(record, name) for name in record.columns},
    }


def _signal_object(record: Record, name: str) -> dict[str, Any]:
    known = record.columns[name][np.isfinite(record.columns[name])]
    return {
        "unit": record.units.get(name),
        "missing": record.rows - int(known.size),
        "lowest": float(known.min()) if known.size else None,
        "highest": float(known.max()) if known.size else None,
    }


def table_text(record: Record, file: Path) -> str:
    """Format the output of `info` for a table."""
    found = table_object(record, file)
    period = "" if found["period_s"] is None else f", one each {found['period_s']:g} s"
    since = f", minutes since {found['zero']}" if found["zero"] else ""
    lines = [f"{file}: {record.rows} rows, {found['first_min']:g} to {found['last_min']:g} min{period}{since}"]
    lines += record.remarks
    width = max((len(name) for name in record.columns), default=0)
    for name, signal in found["signals"].items():
        span = "no values" if signal["lowest"] is None else f"{signal['lowest']:g} to {signal['highest']:g}"
        missing = f", {signal['missing']} missing" if signal["missing"] else ""
        lines.append(f"  {name:{width}}  {span} {signal['unit'] or '(unit not known)'}{missing}")
    gaps = found["gaps"]
    lines += [f"gap from {gap['from_min']:g} to {gap['to_min']:g} min" for gap in gaps[:MAX_LINES]]
    lines += [f"and {len(gaps) - MAX_LINES} more gaps"] if len(gaps) > MAX_LINES else []
    return printable_lines(lines if gaps else [*lines, "no gaps"])


def saved_object(saved: RecoveryResult, out: Path) -> dict[str, Any]:
    """The object that `recover --json` prints."""
    return {
        "file": str(out),
        "messages": saved.messages,
        "first_ns": saved.first_ns,
        "last_ns": saved.last_ns,
        "topics": saved.topics,
        "lost": [{"at_byte": damage.at_byte, "what": damage.what} for damage in saved.damages],
        "orphans": saved.orphans,
    }


def saved_text(saved: RecoveryResult, file: Path, out: Path) -> str:
    """Format the output of `recover` for people."""
    span_s = (saved.last_ns - saved.first_ns) / 1e9
    return printable_lines(
        [
            f"{file}: saved {saved.messages} messages of {len(saved.topics)} topics, received over {span_s:.1f} s "
            f"({format_moment(saved.first_ns)} to {format_moment(saved.last_ns)})",
            *(f"  {count:9d}  {topic}" for topic, count in sorted(saved.topics.items())),
            f"not saved: {saved.losses}" if saved.losses else "nothing was damaged",
            f"wrote {out}",
        ]
    )


def info_object(seen: FileInfo, file: Path) -> dict[str, Any]:
    """The object that `info --json` prints; minutes are those of the plant, as `cut` counts them."""
    overview = seen.overview

    def minutes(time_ns: int | None) -> float | None:
        return None if time_ns is None else to_minutes(time_ns, seen.zero_ns)

    span = overview.sample_span_ns
    return {
        "file": str(file),
        "zero": format_utc(seen.zero_ns) if span is not None and has_clock(seen.metadata) else None,
        "whole": not seen.damages,
        "damages": list(seen.damages),
        "messages": overview.messages,
        "first_ns": overview.first_ns,
        "last_ns": overview.last_ns,
        "span_s": overview.span_s,
        "from_min": minutes(span[0]) if span is not None else None,
        "to_min": minutes(span[1]) if span is not None else None,
        "runs": [
            {"plant": plant, "from_min": minutes(run.first_ns), "to_min": minutes(run.last_ns)}
            for plant, runs in sorted(overview.runs.items())
            for run in runs
        ],
        "topics": [
            {
                "topic": topic.key,
                "encoding": topic.encoding,
                "messages": topic.count,
                "rate_per_s": topic.count / overview.span_s if overview.span_s else None,
            }
            for _, topic in sorted(overview.topics.items())
        ],
        "lost": overview.lost,
        "duplicated": overview.duplicated,
        "out_of_order": overview.out_of_order,
        "out_of_place": overview.out_of_place,
        "gaps": [
            {"topic": gap.key, "first": gap.first, "last": gap.last, "after_min": minutes(gap.after_ns)}
            for gap in overview.gaps
        ],
        "lost_on_the_way": [
            {name: getattr(gap, name) for name in ("stream", "messages", "first", "last", "noticed_ns")}
            for gap in seen.gaps
        ],
        "alarms": [
            {
                "alarm": alarm.alarm,
                "priority": priority_word(alarm.priority),
                "raised_min": minutes(alarm.raised_ns),
                "cleared_min": minutes(alarm.cleared_ns),
                "text": alarm.text,
            }
            for alarm in overview.alarms
        ],
        "metadata": seen.metadata,
        "live": seen.live or None,
        "profile": seen.profile,
        "library": seen.library,
        "attachments": list(seen.attachments),
        "processes": [
            {
                "plant": plant,
                "process": process.name,
                "signals": {
                    signal.name: {"role": signal.role, "unit": signal.unit or None} for signal in process.signals
                },
            }
            for plant, process in sorted(seen.processes.items())
        ],
    }


def info_text(seen: FileInfo, file: Path) -> str:
    """Format the output of `info` for people."""
    report = info_object(seen, file)
    lines = [f"{file}: {report['messages']} messages of {len(report['topics'])} topics"]
    if report["messages"]:
        first, last = format_moment(report["first_ns"]), format_moment(report["last_ns"])
        lines[0] += f", received over {report['span_s']:.1f} s ({first} to {last})"
    if report["from_min"] is not None:
        lines.append(f"samples from {report['from_min']:g} to {report['to_min']:g} min")
    for plant, runs in sorted(seen.overview.runs.items()):
        if len(runs) > 1:
            lines.append(f"{len(runs)} runs of {plant}: its clock steps back, or it was restarted:")
            spans = [(to_minutes(run.first_ns, seen.zero_ns), to_minutes(run.last_ns, seen.zero_ns)) for run in runs]
            named = [f"  run {number}: {first:g} to {last:g} min" for number, (first, last) in enumerate(spans, 1)]
            lines += _first_lines(named, "more")
    if seen.live:
        lines.append(f"{seen.live} is still being recorded: this is its intact part")
    if not seen.metadata:
        encodings = sorted({topic["encoding"] for topic in report["topics"]})
        lines.append(
            f"of another program: profile {seen.profile!r}, library {seen.library!r}, "
            f"encodings {', '.join(map(repr, encodings)) or 'none'}"
        )
    if seen.attachments:
        lines.append(f"attachments: {', '.join(seen.attachments)}")
    facts = [
        f"{name} {seen.metadata[name]}" for name in ("plant", "version", "seed", "started") if name in seen.metadata
    ]
    lines += [", ".join(facts)] if facts else []
    lines += [
        f"{plant} is a process {process.name!r}: {'; '.join(_describe_roles(process))}"
        for plant, process in sorted(seen.processes.items())
    ]
    lines += [
        f"  {topic['messages']:9d}  {topic['rate_per_s'] or 0.0:9.3g}/s  {topic['topic']}" for topic in report["topics"]
    ]
    if report["lost"]:
        lines.append(f"{report['lost']} samples are missing:")
    gaps = [
        f"  {gap['last'] - gap['first'] + 1:9d}  {gap['topic']}: {gap['first']} to {gap['last']}, "
        f"after {gap['after_min']:g} min"
        for gap in report["gaps"]
    ]
    lost = [
        f"lost on the way: {gap['messages']} messages of {gap['stream']}, noticed {format_moment(gap['noticed_ns'])}"
        for gap in report["lost_on_the_way"]
    ]
    lines += [*_first_lines(gaps, "more gaps"), *_first_lines(lost, "times more")]
    if report["out_of_place"]:
        lines.append(f"{report['out_of_place']} samples have a time or number that fits no other")
    if not report["lost"]:
        lines.append("no sample is missing, by their sequence numbers")
    lines += [
        f"  {alarm['raised_min']:9g} min  {alarm['alarm']} ({alarm['priority']}), "
        + ("not cleared" if alarm["cleared_min"] is None else f"cleared at {alarm['cleared_min']:g} min")
        + f": {alarm['text']}"
        for alarm in report["alarms"]
    ]
    if not report["alarms"]:
        lines.append("no alarms")
    if seen.damages:
        lines.append(f"not whole: {'; '.join(seen.damages)}; `reactorwatch recover {file}` saves the rest")
    return printable_lines(lines)


def _first_lines(lines: list[str], more: str) -> list[str]:
    """The first lines, and the number of the others."""
    others = len(lines) - MAX_LINES
    return [*lines[:MAX_LINES], *([f"  and {others} {more} (--json names them)"] if others > 0 else [])]


def _describe_roles(process: Process) -> Iterator[str]:
    """Signals of each role: `inputs Q1, Q2 (cm3/s)`."""
    for role in ROLES:
        signals = [signal for signal in process.signals if signal.role == role]
        by_unit = {signal.unit: [item.name for item in signals if item.unit == signal.unit] for signal in signals}
        groups = [f"{', '.join(names)}{f' ({unit})' if unit else ''}" for unit, names in by_unit.items()]
        if groups:
            yield f"{role}{'s' if len(signals) > 1 else ''} {', '.join(groups)}"
