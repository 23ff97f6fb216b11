"""A back-test in words."""

from typing import TYPE_CHECKING

from reactorwatch.records.record import format_utc
from reactorwatch.sentences.incidents import alarm_lines, headline
from reactorwatch.sentences.promise import REMEDY, describe_broken_promise, describe_power
from reactorwatch.terminal import printable_lines

if TYPE_CHECKING:
    from reactorwatch.results.backtest import Backtest

REFERENCES = {"arx": "identified models (ARX)", "black-box": "a black box learned from the training"}
"""References without equations, for people."""


def backtest_headline(result: "Backtest") -> list[str]:
    """Outcome in a line for each incident, the largest first, after doubts about the training."""
    doubt = ""
    if not result.watched:
        doubt = f"nothing was watched: {result.why}"
        if not result.alarms:
            return [doubt]
    elif result.promise is not None and not result.promise.kept:
        assert result.can_keep_per_30_days is not None
        doubt = f"not trustworthy yet: {describe_broken_promise(result.can_keep_per_30_days)}; {REMEDY}"
    return headline(result.alarms, result.zero_ns, result.clock_zero_ns, doubt)


def exclusion_sentences(result: "Backtest") -> list[str]:
    """Signals that are not watched, with the reason."""
    return [f"{item.signal} is not watched: {item.why}" for item in result.signals.left_out]


def training_sentence(result: "Backtest") -> str:
    """End of the training, and the false alarms that are expected after it."""
    trained_min, expected = result.trained_until_min, result.expected_false_alarms
    if trained_min is None:
        return f"Nothing was watched: {result.why}."
    return f"Trained until {trained_min:g} min; {expected:.2g} false alarms are expected later."


def backtest_text(result: "Backtest") -> str:
    """Lines for a terminal: record, headline, training, promise, sensitivity, alarms and notes."""
    since = "" if result.clock_zero_ns is None else f", minutes since {format_utc(result.clock_zero_ns)}"
    lines = [f"{result.file}: {result.samples} rows over {result.span_min:g} min{since}", *backtest_headline(result)]
    lines += [f"  {sentence}" for sentence in exclusion_sentences(result)]
    if result.runs > 1:
        lines.append(
            f"the plant's clock steps back, or the plant was restarted: {result.runs} runs, watched one by one"
        )
    if result.trained_until_min is not None:
        where = "on another file" if result.trained_elsewhere else f"until {result.trained_until_min:g} min"
        lines.append(
            f"training: {where} ({result.training_rows} rows); "
            f"{result.expected_false_alarms:.2g} false alarms are expected in the rest by chance"
        )
        lines.append(_reference_line(result))
        if result.promise is not None:
            lines.append(f"promise: {result.promise.text}")
        if result.power:
            seen = describe_power(result.power)
            lines.append(f"sensitivity: in nine of ten cases these steps are seen within an hour: {seen}")
    lines += alarm_lines(result.alarms, result.zero_ns)
    is_stated = result.promise is not None  # above, as of the end
    lines += [f"  note: {note}" for note in result.notes if not (is_stated and note.startswith("promise: "))]
    if result.refused:
        lines.append("refused: " + ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items())))
    return printable_lines(lines)


def _reference_line(result: "Backtest") -> str:
    """Line with the reference and its noise levels."""
    if result.noise_levels is None:
        return f"reference: {REFERENCES.get(result.reference or '', result.reference)}"
    levels = (f"{name} {sd:.3g}" for name, sd in result.noise_levels.sensors.items())
    return f"reference: the equations; standard deviation of the sensors' noise: {', '.join(levels)}"
