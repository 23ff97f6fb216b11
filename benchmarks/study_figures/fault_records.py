"""Figures 17 to 20: concentration under the report's output-error model, for the four fault records."""

from dataclasses import dataclass
from functools import cache

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchmarks.harness.plants import messages_of
from benchmarks.study_figures.report_scheme import WIDTH, ReportChart, chart_output
from benchmarks.study_figures.study import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    NAMES,
    ORANGE,
    OUTPUTS,
    TRAINING_ROWS,
    VERMILION,
    Finding,
    Study,
    Verdict,
    label,
    legend_below,
    panels,
)
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import NOISE_SD, ONSET_MIN, OPERATION
from reactorwatch.records.record import Record, to_minutes
from reactorwatch.spc.charts.shewhart import probability_out

UNITS = cstr().units
PRESET_OF = dict(zip(("17", "18", "19", "20"), OPERATION.presets, strict=True))
_SEEDS = 5
_EXPECTED = round(100 * probability_out(WIDTH), 2)  # % of independent normal residuals are outside mean +- 3 sigma


@dataclass(frozen=True)
class Watch:
    """Outcome of the watch of a record by the report's scheme and by the monitor."""

    charts: dict[str, ReportChart]  # report's chart of each output
    out: dict[str, tuple[float, float]]  # share of the rows outside the limits before the onset and after it
    first_min: float | None  # time of the first row after the onset that is out, for C or T; None: none is
    false_points: int  # rows after the training and before the onset that are out, C and T together
    monitor_min: float | None  # time of the monitor's first alarm; None: none
    monitor_false: int  # monitor's alarms before the onset
    cause: str  # likeliest cause that the monitor named, with its probability


@cache
def watch(study: Study, name: str) -> Watch:
    """Watch the fault record of a preset by both."""
    record = study.fault_record(name)
    since = record.time_min >= ONSET_MIN
    watched = np.arange(record.rows) >= TRAINING_ROWS
    charts = {
        output: chart_output(record.columns["qc"], record.columns[output], record.time_min, TRAINING_ROWS)
        for output in OUTPUTS
    }
    out = {
        output: (100 * float(chart.out[watched & ~since].mean()), 100 * float(chart.out[since].mean()))
        for output, chart in charts.items()
    }
    either = np.any([chart.out for chart in charts.values()], axis=0)
    late = record.time_min[either & since]
    alarms = _monitor_alarms(record)
    faulty = name != OPERATION.presets[0].name
    true = [item for item in alarms if faulty and item[0] >= ONSET_MIN]
    return Watch(
        charts,
        out,
        float(late[0]) if late.size and faulty else None,
        int(sum((chart.out & watched & (~since if faulty else True)).sum() for chart in charts.values())),
        true[0][0] if true else None,
        len(alarms) - len(true),
        true[0][1] if true else "",
    )


def draw_record(study: Study, drawing: Drawing, key: str) -> Finding:
    """One of the figures 17 to 20."""
    preset = PRESET_OF[key]
    record, found = study.fault_record(preset.name), watch(study, preset.name)
    over, under = panels(drawing, 2, 1, sharex=True)
    chart, C, t = found.charts["C"], record.columns["C"], record.time_min
    over.plot(t, C, ".", color=GREY, markersize=1.5, label="measured")
    over.plot(t, C - chart.residuals, color=BLUE, linewidth=0.7, label="report's OE(3,3) model")
    label(over, "", NAMES["C"], f"{preset.name}: {preset.meaning}")
    draw_residuals(under, t, chart)
    label(under, "time, min", f"residual, {UNITS['C']}")
    faulty = bool(preset.settings["faults"])
    if faulty:
        for one in (over, under):
            one.axvline(ONSET_MIN, color=ORANGE, linewidth=1.6)
    over.set_ylim(*np.nanpercentile(C, [0, 100]) + np.array([-0.01, 0.01]))
    legend_below(drawing, over, 2)
    before, after = found.out["C"]
    mean, sd = chart.mean, chart.sd
    text = (
        f"Model and limits, {mean:.2e} +- {WIDTH:g} times {sd:.4f} mol/l, from the first {t[TRAINING_ROWS]:g} min. "
        f"Outside them are {before:.2f} % of the rows of C "
    )
    if not faulty:
        share = 100 * float(chart.out[TRAINING_ROWS:].mean())
        text = text.replace(f"{before:.2f} %", f"{share:.2f} %")
        text += (
            f"after the training, and {100 * float(found.charts['T'].out[TRAINING_ROWS:].mean()):.2f} % of T; "
            f"{_EXPECTED} % are to be expected of independent normal residuals. These are {found.false_points} points, "
            "each of which the report's scheme calls a fault. "
            f"The monitor raises {found.monitor_false or 'no'} alarm{'s' * (found.monitor_false > 1)} on this "
            "record.\n\n" + _sound_shares(study)
        )
        return Finding(text, Verdict.AGREES if found.false_points == 0 else Verdict.IN_PART)
    first = "in no row" if found.first_min is None else f"first {found.first_min - ONSET_MIN:.1f} min after it (C or T)"
    seen = "none" if found.monitor_min is None else f"after {found.monitor_min - ONSET_MIN:.1f} min; {found.cause}"
    text += (
        f"before the onset at {ONSET_MIN:g} min and **{after:.2f} %** after it: {100 - after:.2f} % of the faulty "
        f"rows are missed. A residual is out {first}. The monitor's first alarm: {seen}."
    )
    return Finding(text, Verdict.AGREES if after > 5 * max(before, _EXPECTED) else Verdict.IN_PART)


def _sound_shares(study: Study) -> str:
    """Shares of the rows of sound records that are out by the report's scheme, with noise and without, as a table."""
    lines = []
    noisy = f"noise of {NOISE_SD['C']:g} mol/l and {NOISE_SD['T']:g} K"
    for name, noise in ((noisy, None), ("no noise", {"C": 0.0, "T": 0.0})):
        for model in ("arx", "oe"):
            shares = []
            for seed in range(study.seed, study.seed + _SEEDS):
                settings = {"seed": seed, **OPERATION.presets[0].settings}
                config = msgspec.convert(settings, PlantConfig)
                record = simulate_record(config if noise is None else msgspec.structs.replace(config, noise_sd=noise))
                u, t = record.columns["qc"], record.time_min
                charts = [chart_output(u, record.columns[output], t, TRAINING_ROWS, model) for output in OUTPUTS]
                shares += [100 * float(chart.out[TRAINING_ROWS:].mean()) for chart in charts]
            lines.append(
                f"| {model.upper()}(3,3) | {name} | {np.mean(shares):.2f} % | {min(shares):.2f} to {max(shares):.2f} "
                "% |"
            )
    return (
        f"Over {_SEEDS} sound records with other noise and inputs, for C and T, the share of the rows after the "
        f"training that are out:\n\n| model | record | mean | range |\n|---|---|---|---|\n" + "\n".join(lines)
    )


def draw_residuals(axes: Axes, time_min: Array, chart: ReportChart) -> None:
    """Draw a residual with its limits and the rows learned from; the points that are out are marked."""
    axes.plot(time_min, chart.residuals, color=BLUE, linewidth=0.5)
    axes.plot(time_min[chart.out], chart.residuals[chart.out], ".", color=VERMILION, markersize=3.5)
    for limit in chart.limits:
        axes.axhline(limit, color=BLACK, linewidth=1, linestyle="--")
    axes.axvspan(time_min[0], time_min[TRAINING_ROWS], color=GREEN, alpha=0.1)


def compare(study: Study, drawing: Drawing) -> Finding:
    """The report's scheme beside the monitor: detection, delay, false alarms and cause."""
    found = [(preset, watch(study, preset.name)) for preset in OPERATION.presets]
    (axes,) = panels(drawing, 1, 1)
    for row, (preset, item) in enumerate(found):
        record = study.fault_record(preset.name)
        for offset, output, colour in ((0.16, "C", VERMILION), (0.0, "T", ORANGE)):
            out = item.charts[output].out & (np.arange(record.rows) >= TRAINING_ROWS)
            axes.plot(
                record.time_min[out],
                np.full(int(out.sum()), -row + offset),
                "|",
                color=colour,
                markersize=9,
                label=f"report: {output} is out" if row == 0 else "_",
            )
        if item.monitor_min is not None:
            axes.plot(
                item.monitor_min,
                -row - 0.2,
                "v",
                color=BLUE,
                markersize=9,
                label="monitor's first alarm" if row == 1 else "_",
            )
    axes.axvline(ONSET_MIN, color=BLACK, linewidth=1, linestyle="--")
    axes.set_yticks([-row for row in range(len(found))], [preset.name for preset, _ in found])
    axes.set_ylim(-len(found) + 0.5, 0.6)
    label(axes, "time, min", "")
    legend_below(drawing, axes, 3)
    rows = []
    for preset, item in found:
        report = monitor = missed = ""
        if preset.settings["faults"]:
            report, monitor = (
                "not seen" if minute is None else f"{minute - ONSET_MIN:.1f} min"
                for minute in (item.first_min, item.monitor_min)
            )
            missed = f"{100 - item.out['C'][1]:.1f} / {100 - item.out['T'][1]:.1f} %"
        rows.append(
            f"| `{preset.name}` | {report} | {missed} | {item.false_points} | {monitor} | {item.monitor_false} | "
            f"{item.cause or 'none'} |"
        )
    false = sum(item.false_points for _, item in found)
    text = (
        "The first point out after the onset counts as the report's detection, though chance alone gives one soon; its "
        "false alarms are the points that are out before the onset.\n\n"
        "| record | report: first point out | report: rows missed, C / T | report: false points | monitor: first "
        "alarm | monitor: false alarms | monitor: cause |\n|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        f"The report's scheme sees the faults, with {false} false points in these four records, and names no cause. "
        "Its abstract announces detection, isolation and reconstruction; its text shows detection."
    )
    seen = all(item.first_min is not None for preset, item in found if preset.settings["faults"])
    return Finding(text, Verdict.IN_PART if seen else Verdict.DISAGREES)


def _monitor_alarms(record: Record) -> list[tuple[float, str]]:
    """Times of the monitor's alarms with the likeliest cause, in order."""
    result = backtest.run(messages_of(record), MonitorConfig())
    alarms = []
    for alarm, _ in sorted(result.raised_alarms, key=lambda item: item[0].raised_ns):
        cause = f"{alarm.suspects[0].cause} ({100 * alarm.suspects[0].probability:.0f} %)" if alarm.suspects else ""
        alarms.append((to_minutes(alarm.raised_ns, result.first_ns), cause))
    return alarms
