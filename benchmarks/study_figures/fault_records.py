"""Figure 19: the four fault records, their residuals, and when each fault is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.study_figures.canvas import GREEN, ORANGE, label, panels
from benchmarks.study_figures.control_limits import draw_residuals, monitor_record, out_of
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.study import TRAINING_ROWS, Study
from monitor_node.alarms.on_off_delay import OnOffDelay
from monitor_node.config import MonitorConfig
from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.library.cstr.operation import ONSET_MIN, OPERATION

UNITS = cstr().units

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_OUTPUTS = ("T", "C")


def draw(study: Study, drawing: Drawing) -> Finding:
    """Residuals of T and C for each record, the alarm marked."""
    rule = MonitorConfig()
    axes = iter(panels(drawing, len(OPERATION.presets), len(_OUTPUTS), sharex=True, sharey="col"))
    rows, right = [], 0
    for preset in OPERATION.presets:
        record = study.fault_record(preset.name)
        faulty, cells, seen = bool(preset.settings["faults"]), [], False
        for output in _OUTPUTS:
            one = next(axes)
            _, residuals, chart = monitor_record(record, output)
            if chart is None:
                cells.append("not sampled well | ")
                continue
            out = out_of(chart, residuals)
            raised = _alarms(record.time_min, out, rule)
            before = [time for time in raised if time < ONSET_MIN or not faulty]
            after = [time for time in raised if faulty and time >= ONSET_MIN]
            draw_residuals(one, record.time_min, residuals, chart, out)
            one.axvspan(0.0, record.time_min[TRAINING_ROWS], color=GREEN, alpha=0.1)
            if faulty:
                one.axvline(ONSET_MIN, color=ORANGE, linewidth=1.6)
            for time in (*before[:1], *after[:1]):
                one.plot(time, 0.93, "v", color="black", markersize=6, transform=one.get_xaxis_transform())
            label(one, "", UNITS[output], f"{preset.name}: residual of {output}")
            seen |= bool(after) if faulty else bool(before)
            since = record.time_min >= ONSET_MIN
            cells.append(f"{100 * out[since].mean():.2f} % | {_format_delays(after, before, faulty)}")
        right += seen == faulty
        rows.append(f"| `{preset.name}` ({preset.meaning}) | {' | '.join(cells)} |")
    for one in drawing.axes[-len(_OUTPUTS) :]:
        one.set_xlabel("time, min")
    text = (
        f"Third-order ARX models learned from the first {record.time_min[TRAINING_ROWS]:g} min, limits mean +- 3 "
        f"sigma; faults set in at {ONSET_MIN:g} min. One point that is out is no alarm, as chance alone gives one in "
        f"370: the alarm takes {rule.raise_count} of {rule.window}.\n\n| record | T: out since {ONSET_MIN:g} min | "
        f"alarm | C: out since {ONSET_MIN:g} min | alarm |\n"
        "|---|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        f"Right in {right} of {len(OPERATION.presets)} records (an alarm after the onset of a fault, none without a "
        "fault). In the pictures the shaded rows are those learned from, the line is the onset, the triangle the first "
        "alarm. Shewhart's chart has no memory: faults that shift the residual by less than its noise it sees late or "
        "only for moments."
    )
    if right == len(OPERATION.presets):
        return Finding(text, Verdict.AGREES)
    return Finding(text, Verdict.IN_PART if right else Verdict.DISAGREES)


def _alarms(time_min: Array, out: Array, rule: MonitorConfig) -> list[float]:
    """Times of the alarm in the watched rows."""
    persistence = OnOffDelay(rule.raise_count, rule.window, rule.clear_count)
    return [
        float(time)
        for time, is_out in zip(time_min[TRAINING_ROWS:], out[TRAINING_ROWS:], strict=True)
        if persistence.update(bool(is_out))
    ]


def _format_delays(after: list[float], before: list[float], faulty: bool) -> str:
    early = f"{len(before)} false" if before else ""
    if not faulty:
        return early or "none"
    seen = f"{after[0] - ONSET_MIN:.1f} min after the onset" if after else "none"
    return f"{seen}, {early} before" if early else seen
