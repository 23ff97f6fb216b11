"""Panels of a diagnosis: measurements and simulations, residuals, and the causes."""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.result import NOMINAL, SD_95, Cause, Curves, Diagnosis, Experiment
from reactorwatch.figures import Band, Line, Mark, Panel
from reactorwatch.process.model import Output, ProcessModel

BEFORE_ROWS, AFTER_ROWS = 100, 200
"""Rows of the close-up, before and after its centre."""

RESIDUALS_SHOWN = (4.0, 0.99, 1.25)
"""Axis of residuals: at least this many standard deviations, or this factor times this quantile."""

ALTERNATIVES = ("after", "before", "input", "other", "measured")
"""Kinds of the lines of up to five explanations."""


def outputs(diagnosis: Diagnosis, model: ProcessModel) -> list[Panel]:
    """Measurements of each output, with the simulation before and with the extended one."""
    return [_compare(diagnosis, output, slice(None)) for output in model.outputs]


def closer(diagnosis: Diagnosis, model: ProcessModel) -> list[Panel]:
    """Close-up of the rows where the two models differ: outputs and inputs."""
    curves = _curves(diagnosis)
    rows = _rows_of_interest(curves, diagnosis.causes)
    result = [_compare(diagnosis, output, rows) for output in model.outputs]
    for item in model.inputs:
        line = Line(item.meaning, curves.time_min[rows], curves.inputs[item.name][rows], "input", steps=True)
        result.append(Panel(f"{item.name}, {item.unit}", (line,)))
    return result


def residuals(diagnosis: Diagnosis, model: ProcessModel) -> list[Panel]:
    """Residuals in standard deviations: one-step-ahead without and with the cause, with nuisance of the simulation."""
    curves = _curves(diagnosis)
    kinds = [("simulation as it is", "after" if diagnosis.verdict == NOMINAL else "before", curves.residual_before)]
    if diagnosis.with_nuisance:  # errors of a simulation, which those of a filter without the cause are no match for
        kinds = [("with the cause" if diagnosis.causes else "with small corrections", "after", curves.residual_after)]
    elif diagnosis.is_extended:
        what = "the cause" if diagnosis.causes else "the law"
        kinds = [
            (f"without {what}", "before", curves.residual_before),
            (f"with {what}", "after", curves.residual_after),
        ]
    ends = np.full(curves.time_min.size, SD_95)
    result = []
    for output in model.outputs:
        for text, kind, columns in kinds:
            values = columns[output.name]
            least, share, more = RESIDUALS_SHOWN
            finite = np.abs(values[np.isfinite(values)])
            reach = max(more * float(np.quantile(finite, share)) if finite.size else 0.0, least)
            items = (
                Line(text, curves.time_min, values, kind),
                Band("95 % of noise", curves.time_min, -ends, ends, "expected"),
            )
            title = f"Residual of {output.name}, standard deviations"
            marks, alternative = _onsets(diagnosis.causes), f"residual of {output.name}, {text}"
            result.append(Panel(title, items, marks, limits=(-reach, reach), text=alternative))
    return result


def courses(diagnosis: Diagnosis) -> list[Panel]:
    """Deviation of each cause over time, with its 95 % band."""
    curves, result = _curves(diagnosis), []
    for cause in diagnosis.causes:
        course, ends = curves.deviation[cause.cause], interval(cause, curves)
        items = (
            Line("most likely", curves.time_min, course, "after"),
            Band("95 % interval", curves.time_min, *ends, "after"),
        )
        title = f"Size m of: {cause.label}{_unit(cause.parameters['size'].unit)}"
        result.append(Panel(title, items, limits=_with_zero(course, *ends), text=f"course of {cause.label}"))
    return result


def experiment(proposed: Experiment, model: ProcessModel) -> list[Panel]:
    """Proposed input, outputs predicted by each explanation, and their differences."""
    curves = proposed.curves
    if curves is None:
        raise ValueError("an experiment without its curves cannot be drawn")
    times, first = curves.time_min, next(iter(curves.outputs))
    item = next(item for item in model.inputs if item.name == proposed.signal)
    limits = {
        name: [Line("limits", times, np.full(times.size, end), "limit") for end in proposed.limits[name]]
        for name in (item.name, *model.output_names)
    }
    given = (Line(item.meaning, times, curves.level, "input", steps=True), *limits[item.name])
    result = [Panel(f"{item.name}, {item.unit}", given, text=f"proposed {item.name}")]
    for name, unit in ((output.name, output.unit) for output in model.outputs):
        lines = [
            Line(label, times, columns[name], kind)
            for (label, columns), kind in zip(curves.outputs.items(), ALTERNATIVES, strict=False)
        ]
        title = f"{name}, {unit}, as predicted under each"
        result.append(Panel(title, (*lines, *limits[name]), text=f"predicted {name}"))
        apart = tuple(Line(line.label, times, line.y - lines[0].y, line.kind) for line in lines[1:])
        title = f"{name}, {unit}, less what is predicted under {first}"
        result.append(Panel(title, apart, text=f"differences of predicted {name}"))
    return result


def law(diagnosis: Diagnosis) -> list[Panel]:
    """Missing term over each of its variables: the smooth curve with its 95 % band, and the formula."""
    if diagnosis.law is None:
        return []
    result = []
    for curve in diagnosis.law.curves:
        half = SD_95 * curve.smooth_sd
        ends = curve.smooth - half, curve.smooth + half
        items = (
            Line("smooth curve", curve.values, curve.smooth, "after"),
            Band("95 % interval", curve.values, *ends, "after"),
            Line(diagnosis.law.formula, curve.values, curve.formula, "limit"),
        )
        title = f"Missing term{_unit(diagnosis.law.unit)}, over {curve.variable}"
        shown, alternative = _with_zero(curve.smooth, *ends), f"missing term over {curve.variable}"
        result.append(Panel(title, items, x_title=curve.unit, limits=shown, text=alternative))
    return result


def unknown_course(diagnosis: Diagnosis) -> list[Panel]:
    """Course of an unknown input, if there is one."""
    curves = _curves(diagnosis)
    unknown = curves.unknown
    if unknown is None:
        return []
    title, shown = f"Estimated as the size of: {unknown.label}{_unit(unknown.unit)}", _with_zero(*(unknown.size,) * 3)
    line = Line("most likely", curves.time_min, unknown.size, "after")
    return [Panel(title, (line,), limits=shown, text="course of the unknown input")]


def _unit(unit: str) -> str:
    return "" if unit == "1" else f", {unit}"


def interval(cause: Cause, curves: Curves) -> tuple[Array, Array]:
    """Ends of the 95 % interval of a cause's magnitude, each of shape (rows,).

    Near its onset a step may or may not have set in; its interval is within zero and the magnitude's interval.
    """
    course, half = curves.deviation[cause.cause], SD_95 * curves.deviation_sd[cause.cause]
    lower, upper = course - half, course + half
    if cause.profile != "step":
        return lower, upper
    size = cause.parameters["size"]
    ends = (0.0, size.value - SD_95 * size.sd, size.value + SD_95 * size.sd)
    return np.clip(lower, min(ends), max(ends)), np.clip(upper, min(ends), max(ends))


def _compare(diagnosis: Diagnosis, output: Output, rows: slice) -> Panel:
    """Measurements of an output, the simulation as it was, and the extended one."""
    curves, title = _curves(diagnosis), f"{output.name}, {output.unit}"
    times, name = curves.time_min[rows], output.name
    nominal = diagnosis.verdict == NOMINAL and not diagnosis.with_nuisance
    before = ("simulation", "after") if nominal else ("simulation as it was", "before")
    lines = [
        Line("measured", times, curves.measured[name][rows]),
        Line(before[0], times, curves.simulated_before[name][rows], before[1]),
    ]
    if diagnosis.is_extended or diagnosis.with_nuisance:
        after = "extended simulation" if diagnosis.is_extended else "with small corrections"
        lines.append(Line(after, times, curves.simulated_after[name][rows], "after"))
    text = f"{title}: {', '.join(line.label for line in lines)}"
    return Panel(title, tuple(lines), _onsets(diagnosis.causes), text=text)


def _rows_of_interest(curves: Curves, causes: Sequence[Cause]) -> slice:
    """Rows around the first onset, or where the two models differ most."""
    onsets = _onsets(causes)
    if onsets:
        centre = int(np.searchsorted(curves.time_min, min(mark.x for mark in onsets)))
    else:
        off = np.zeros(curves.time_min.size)
        for name, before in curves.simulated_before.items():
            difference = np.abs(np.nan_to_num(curves.simulated_after[name] - before))
            off += difference / max(float(difference.max()), 1e-300)
        centre = int(np.argmax(off))
    begin = max(min(centre - BEFORE_ROWS, curves.time_min.size - BEFORE_ROWS - AFTER_ROWS), 0)
    return slice(begin, begin + BEFORE_ROWS + AFTER_ROWS)


def _onsets(causes: Sequence[Cause]) -> tuple[Mark, ...]:
    """Onsets that were estimated and not given."""
    result = [(cause, cause.parameters["onset"]) for cause in causes if "onset" in cause.parameters]
    return tuple(Mark(onset.value + cause.run_shift_min, cause.label) for cause, onset in result if onset.sd > 0.0)


def _with_zero(course: Array, lower: Array, upper: Array) -> tuple[float, float]:
    """Range of the axis, zero included; an infinite interval is cut off."""
    most = 3.0 * max(float(np.max(np.abs(course))), 1e-12)
    lowest = float(np.min(lower, initial=0.0, where=np.isfinite(lower)))
    highest = float(np.max(upper, initial=0.0, where=np.isfinite(upper)))
    return max(lowest, -most), min(highest, most)


def _curves(diagnosis: Diagnosis) -> Curves:
    if diagnosis.curves is None:
        raise ValueError("a diagnosis without its curves cannot be drawn")
    return diagnosis.curves
