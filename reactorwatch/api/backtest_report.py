"""Output of `backtest`: a JSON object, or lines for people."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from monitor_node.replay.backtest import Backtest
from monitor_node.watch.promise import REMEDY, describe_rate
from reactorwatch.api.alarm_lines import alarm_lines, headline
from reactorwatch.contract.alarm_text import priority_word
from reactorwatch.contract.messages_pb2 import Promise
from reactorwatch.contract.promise_text import describe_power, promise_fields
from reactorwatch.limits import parse_json
from reactorwatch.records.record import format_utc, to_minutes
from reactorwatch.terminal import printable_lines

REFERENCES = {"arx": "identified models (ARX)", "black-box": "a black box learned from the training"}
"""References without equations, for people."""


def backtest_object(
    result: Backtest, zero_ns: int, zero: str | None = None, *, is_trained: bool = False
) -> dict[str, Any]:
    """The object that `backtest --json` prints.

    Args:
        result: result of the back-test.
        zero_ns: time from which the file's minutes are counted.
        zero: the same time as ISO 8601; None: unknown.
        is_trained: True if the training was on another file.
    """

    def minutes(time_ns: int | None) -> float | None:
        return None if time_ns is None else to_minutes(time_ns, zero_ns)

    return {
        "watched": not result.not_watched,
        "why": result.not_watched or None,
        "samples": result.rows,
        "zero": zero,
        "span_min": to_minutes(result.span_ns),
        "runs": result.runs,
        "trained_until_min": 0.0 if is_trained else minutes(result.watching_since_ns),
        "expected_false_alarms": float(f"{result.expected_false_alarms:.3g}"),
        **_promise(result.promise, result.expected_false_alarms),
        "signals": {
            "inputs": [name for name in result.inputs if name not in result.left_out],
            "outputs": [name for name in result.outputs if name not in result.left_out],
            "left_out": [{"signal": name, "why": why} for name, why in result.left_out.items()],
        },
        "reference": result.reference,
        "noise_levels": result.noise_levels,
        "baseline": _baseline(result, minutes),
        "alarms": [
            {
                "alarm": alarm.alarm,
                "priority": priority_word(alarm.priority),
                "raised_min": minutes(alarm.raised_ns),
                "cleared_min": minutes(cleared_ns),
                "signals": [item.signal for item in alarm.contributions],
                "contributions": [{"signal": item.signal, "share": item.share} for item in alarm.contributions],
                "suspect": [
                    {"cause": item.cause, "probability": item.probability, "text": item.text} for item in alarm.suspects
                ],
            }
            for alarm, cleared_ns in result.raised_alarms
        ],
    }


def _promise(promise: Promise | None, expected: float) -> dict[str, Any]:
    """Fields `promise`, for the rows that were judged, and `power`.

    Args:
        promise: the promise at the end of the record; None: no row was judged.
        expected: false alarms promised in these rows.
    """
    fields = promise_fields(promise)
    if promise is not None:
        upper = expected * promise.expected_90 / promise.expected
        fields["promise"] |= {"expected": float(f"{expected:.3g}"), "expected_90": float(f"{upper:.3g}")}
    return fields


def _baseline(result: Backtest, minutes: Callable[[int], float | None]) -> dict[str, Any] | None:
    """Change of the model after the diagnosis of the training; None without one."""
    change = result.baseline
    if change is None:
        return None
    model = parse_json(change.model)
    return {"what": change.what, "from_min": minutes(change.time_ns), "why": change.why, "extended_model": model}


def backtest_headline(result: Backtest, zero_ns: int, clock_zero_ns: int | None = None) -> list[str]:
    """Lines that state the outcome; arguments as for `backtest_text`."""
    doubt, promise, raised = "", result.promise, result.raised_alarms
    if result.not_watched:
        doubt = f"nothing was watched: {result.not_watched}"
        if not raised:
            return [doubt]
    elif promise is not None and not promise.kept:
        rate = describe_rate(promise.can_keep_per_30_days)
        doubt = f"not trustworthy yet: by its training, false alarms may come {rate}; {REMEDY}"
    return headline(raised, zero_ns, clock_zero_ns, doubt)


def backtest_text(
    result: Backtest, zero_ns: int, file: Path, clock_zero_ns: int | None = None, *, is_trained: bool = False
) -> str:
    """Format the result of `backtest` for people; arguments as for `backtest_object`.

    Args:
        result: see there.
        zero_ns: see there.
        file: the record.
        clock_zero_ns: clock time of `zero_ns`; None: unknown.
        is_trained: see there.
    """
    report = backtest_object(result, zero_ns, is_trained=is_trained)
    since = "" if clock_zero_ns is None else f", minutes since {format_utc(clock_zero_ns)}"
    lines = [f"{file}: {report['samples']} rows over {report['span_min']:g} min{since}"]
    lines += backtest_headline(result, zero_ns, clock_zero_ns)
    lines += [f"  {name} is not watched: {why}" for name, why in result.left_out.items()]
    if result.runs > 1:
        lines.append(
            f"the plant's clock steps back, or the plant was restarted: {result.runs} runs, watched one by one"
        )
    if report["trained_until_min"] is not None:
        where = "on another file" if is_trained else f"until {report['trained_until_min']:g} min"
        lines.append(
            f"training: {where} ({result.training_rows} rows); "
            f"{report['expected_false_alarms']:.2g} false alarms are expected in the rest by chance"
        )
        lines.append(_reference_line(result))
        if result.promise is not None:
            lines.append(f"promise: {result.promise.text}")
        if report["power"]:
            seen = describe_power(report["power"])
            lines.append(f"sensitivity: in nine of ten cases these steps are seen within an hour: {seen}")
    lines += alarm_lines(result.raised_alarms, zero_ns)
    is_stated = result.promise is not None  # above, as of the end
    lines += [f"  note: {note}" for note in result.notes if not (is_stated and note.startswith("promise: "))]
    if result.refused:
        lines.append("refused: " + ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items())))
    return printable_lines(lines)


def _reference_line(result: Backtest) -> str:
    """Line with the reference and its noise levels."""
    if result.noise_levels is None:
        return f"reference: {REFERENCES.get(result.reference or '', result.reference)}"
    levels = (f"{name} {sd:.3g}" for name, sd in result.noise_levels["sensors"].items())
    return f"reference: the equations; standard deviation of the sensors' noise: {', '.join(levels)}"
