"""Figures of a diagnosis: measurements and simulations, residuals, and the causes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.report.svg import Band, Line, plot
from reactorwatch.diagnosis.result import NOMINAL, SD_95, Cause, Curves, Diagnosis, Experiment
from reactorwatch.process.model import ProcessModel

BEFORE_ROWS, AFTER_ROWS = 100, 200
"""Rows of the close-up, before and after its centre."""

RESIDUALS_SHOWN = (4.0, 0.99, 1.25)
"""Axis of residuals: at least this many standard deviations, or this factor times this quantile."""

MEASURED = ("measured", "measured")
BEFORE = ("simulation as it was", "before")
AFTER = ("extended simulation", "after")
RIGHT = ("simulation", "after")
LIMITS = ("limits", "limit")


@dataclass(frozen=True)
class Picture:
    """A figure with its title and legend.

    Attributes:
        title: quantity and unit.
        legend: (text, class) of each line.
        drawing: an `svg` element.
    """

    title: str
    legend: tuple[tuple[str, str], ...]
    drawing: str


def outputs(diagnosis: Diagnosis, model: ProcessModel) -> list[Picture]:
    """Measurements of each output, with the simulation before and with the extended one."""
    curves = _curves(diagnosis)
    moments = _onsets(diagnosis.causes)
    result = []
    for output in model.outputs:
        if diagnosis.verdict == NOMINAL:
            lines = [(MEASURED, curves.measured), (RIGHT, curves.simulated_before)]
        else:
            lines = [(MEASURED, curves.measured), (BEFORE, curves.simulated_before)]
        result.append(_picture(f"{output.name}, {output.unit}", curves, output.name, lines, moments))
        if diagnosis.is_extended:
            lines[1] = (AFTER, curves.simulated_after)
            result.append(_picture(f"{output.name}, {output.unit}", curves, output.name, lines, moments))
    return result


def closer(diagnosis: Diagnosis, model: ProcessModel) -> list[Picture]:
    """Close-up of the rows where the two models differ: outputs and inputs."""
    curves = _curves(diagnosis)
    rows = _rows_of_interest(curves, diagnosis.causes)
    moments = _onsets(diagnosis.causes)
    lines = [(MEASURED, curves.measured), (BEFORE, curves.simulated_before), (AFTER, curves.simulated_after)]
    result = [
        _picture(f"{output.name}, {output.unit}", curves, output.name, lines, moments, rows) for output in model.outputs
    ]
    for item in model.inputs:
        drawing = plot(item.name, curves.time_min[rows], [Line(curves.inputs[item.name][rows], "input", held=True)])
        result.append(Picture(f"{item.name}, {item.unit}", ((item.meaning, "input"),), drawing))
    return result


def residuals(diagnosis: Diagnosis, model: ProcessModel) -> list[Picture]:
    """One-step-ahead residuals in standard deviations, without and with the cause."""
    curves = _curves(diagnosis)
    kinds = [("simulation as it is", "after" if diagnosis.verdict == NOMINAL else "before", curves.residual_before)]
    if diagnosis.is_extended:
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
            drawing = plot(
                f"residual of {output.name}, {text}",
                curves.time_min,
                [Line(values, kind)],
                [Band(-ends, ends, "expected")],
                _onsets(diagnosis.causes),
                (-reach, reach),
            )
            legend = ((text, kind), ("95 % of noise", "expected"))
            result.append(Picture(f"Residual of {output.name}, standard deviations", legend, drawing))
    return result


def courses(diagnosis: Diagnosis) -> list[Picture]:
    """Deviation of each cause over time, with its 95 % band."""
    curves, result = _curves(diagnosis), []
    for cause in diagnosis.causes:
        course = curves.deviation[cause.cause]
        lower, upper = interval(cause, curves)
        unit = cause.parameters["size"].unit
        drawing = plot(
            f"course of {cause.label}",
            curves.time_min,
            [Line(course, "after")],
            [Band(lower, upper, "certain")],
            shown=_with_zero(course, lower, upper),
        )
        title = f"Size m of: {cause.label}{'' if unit == '1' else f', {unit}'}"
        result.append(Picture(title, (("most likely", "after"), ("95 % interval", "certain")), drawing))
    return result


def experiment(proposed: Experiment, model: ProcessModel) -> list[Picture]:
    """Proposed input, outputs predicted by each explanation, and their differences."""
    curves = proposed.curves
    if curves is None:
        raise ValueError("an experiment without its curves cannot be drawn")
    names = list(curves.outputs)
    kinds = [f"alternative{index}" for index in range(len(names))]
    item = model.inputs[0]
    lines = [Line(curves.level, "input", held=True), *_limits(proposed, item.name, curves.time_min.size)]
    drawing = plot(f"proposed {item.name}", curves.time_min, lines)
    result = [Picture(f"{item.name}, {item.unit}", ((item.meaning, "input"), LIMITS), drawing)]
    for output in model.outputs:
        values = [curves.outputs[name][output.name] for name in names]
        lines = [Line(column, kind) for column, kind in zip(values, kinds, strict=True)]
        drawing = plot(
            f"predicted {output.name}", curves.time_min, [*lines, *_limits(proposed, output.name, curves.time_min.size)]
        )
        legend = tuple(zip(names, kinds, strict=True))
        result.append(Picture(f"{output.name}, {output.unit}, as predicted under each", (*legend, LIMITS), drawing))
        lines = [Line(column - values[0], kind) for column, kind in zip(values[1:], kinds[1:], strict=True)]
        drawing = plot(f"differences of predicted {output.name}", curves.time_min, lines)
        title = f"{output.name}, {output.unit}, less what is predicted under {names[0]}"
        result.append(Picture(title, legend[1:], drawing))
    return result


def _limits(proposed: Experiment, name: str, rows: int) -> list[Line]:
    return [Line(np.full(rows, end), "limit") for end in proposed.limits[name]]


def law(diagnosis: Diagnosis) -> list[Picture]:
    """Missing term over each of its variables: the smooth curve with its 95 % band, and the formula."""
    if diagnosis.law is None:
        return []
    result = []
    for curve in diagnosis.law.curves:
        half = SD_95 * curve.smooth_sd
        drawing = plot(
            f"missing term over {curve.variable}",
            curve.values,
            [Line(curve.smooth, "after"), Line(curve.formula, "limit")],
            [Band(curve.smooth - half, curve.smooth + half, "certain")],
            shown=_with_zero(curve.smooth, curve.smooth - half, curve.smooth + half),
            unit=curve.unit,
        )
        unit = "" if diagnosis.law.unit == "1" else f", {diagnosis.law.unit}"
        legend = (("smooth curve", "after"), ("95 % interval", "certain"), (diagnosis.law.formula, "limit"))
        result.append(Picture(f"Missing term{unit}, over {curve.variable}", legend, drawing))
    return result


def unknown_course(diagnosis: Diagnosis) -> list[Picture]:
    """Course of an unknown input, if there is one."""
    curves = _curves(diagnosis)
    unknown = curves.unknown
    if unknown is None:
        return []
    drawing = plot(
        "course of the unknown input",
        curves.time_min,
        [Line(unknown.size, "after")],
        shown=_with_zero(unknown.size, unknown.size, unknown.size),
    )
    unit = "" if unknown.unit == "1" else f", {unknown.unit}"
    return [Picture(f"Estimated as the size of: {unknown.label}{unit}", (("most likely", "after"),), drawing)]


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


def _picture(
    title: str,
    curves: Curves,
    output: str,
    lines: Sequence[tuple[tuple[str, str], dict[str, Array]]],
    moments_min: Sequence[float],
    rows: slice = slice(None),
) -> Picture:
    drawn = [Line(columns[output][rows], kind) for (_, kind), columns in lines]
    measured = curves.measured[output][rows]
    models = np.concatenate([curves.simulated_before[output][rows], curves.simulated_after[output][rows], measured])
    finite = models[np.isfinite(models)]
    shown = (float(finite.min()), float(finite.max())) if finite.size else None  # one scale for before and after
    drawing = plot(
        f"{title}: {', '.join(text for (text, _), _ in lines)}", curves.time_min[rows], drawn, (), moments_min, shown
    )
    return Picture(title, tuple(key for key, _ in lines), drawing)


def _rows_of_interest(curves: Curves, causes: Sequence[Cause]) -> slice:
    """Rows around the first onset, or where the two models differ most."""
    onsets = _onsets(causes)
    if onsets:
        centre = int(np.searchsorted(curves.time_min, min(onsets)))
    else:
        off = np.zeros(curves.time_min.size)
        for name, before in curves.simulated_before.items():
            difference = np.abs(np.nan_to_num(curves.simulated_after[name] - before))
            off += difference / max(float(difference.max()), 1e-300)
        centre = int(np.argmax(off))
    begin = max(min(centre - BEFORE_ROWS, curves.time_min.size - BEFORE_ROWS - AFTER_ROWS), 0)
    return slice(begin, begin + BEFORE_ROWS + AFTER_ROWS)


def _onsets(causes: Sequence[Cause]) -> list[float]:
    """Onsets that were estimated and not given."""
    result = [(cause.parameters["onset"], cause.run_shift_min) for cause in causes if "onset" in cause.parameters]
    return [item.value + shift_min for item, shift_min in result if item.sd > 0.0]


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
