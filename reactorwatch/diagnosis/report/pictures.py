"""Figures of a diagnosis: measurements and simulations, residuals, and the causes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.report.svg import Band, Line, plot
from reactorwatch.diagnosis.result import NOMINAL, SD_95, Cause, Curves, Diagnosis, Experiment
from reactorwatch.process.model import Output, ProcessModel

BEFORE_ROWS, AFTER_ROWS = 100, 200
"""Rows of the close-up, before and after its centre."""

RESIDUALS_SHOWN = (4.0, 0.99, 1.25)
"""Axis of residuals: at least this many standard deviations, or this factor times this quantile."""

EXTENDED = "extended simulation"


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


def _draw(
    title: str,
    alternative: str,
    time_min: Array,
    items: Sequence[Line | Band],
    moments_min: Sequence[float] = (),
    shown: tuple[float, float] | None = None,
    unit: str = "min",
) -> Picture:
    """Picture with a text alternative; for the other arguments see `plot`."""
    legend = dict.fromkeys((item.text, item.kind) for item in items if item.text)
    return Picture(title, tuple(legend), plot(alternative, time_min, items, moments_min, shown, unit))


def outputs(diagnosis: Diagnosis, model: ProcessModel) -> list[Picture]:
    """Measurements of each output, with the simulation before and with the extended one."""
    nominal = diagnosis.verdict == NOMINAL
    simulations = [("simulation", "after") if nominal else ("simulation as it was", "before")]
    simulations += [(EXTENDED, "after")] if diagnosis.is_extended else []
    return [
        _picture(diagnosis, output, [simulation], slice(None)) for output in model.outputs for simulation in simulations
    ]


def closer(diagnosis: Diagnosis, model: ProcessModel) -> list[Picture]:
    """Close-up of the rows where the two models differ: outputs and inputs."""
    curves = _curves(diagnosis)
    rows = _rows_of_interest(curves, diagnosis.causes)
    both = [("simulation as it was", "before"), (EXTENDED, "after")]
    result = [_picture(diagnosis, output, both, rows) for output in model.outputs]
    for item in model.inputs:
        line = Line(curves.inputs[item.name][rows], "input", item.meaning, held=True)
        result.append(_draw(f"{item.name}, {item.unit}", item.name, curves.time_min[rows], [line]))
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
            items: list[Line | Band] = [Line(values, kind, text), Band(-ends, ends, "expected", "95 % of noise")]
            alternative, title = f"residual of {output.name}, {text}", f"Residual of {output.name}, standard deviations"
            moments = _onsets(diagnosis.causes)
            result.append(_draw(title, alternative, curves.time_min, items, moments, (-reach, reach)))
    return result


def courses(diagnosis: Diagnosis) -> list[Picture]:
    """Deviation of each cause over time, with its 95 % band."""
    curves, result = _curves(diagnosis), []
    for cause in diagnosis.causes:
        course, ends = curves.deviation[cause.cause], interval(cause, curves)
        items: list[Line | Band] = [Line(course, "after", "most likely"), Band(*ends, "certain", "95 % interval")]
        title = f"Size m of: {cause.label}{_unit(cause.parameters['size'].unit)}"
        shown = _with_zero(course, *ends)
        result.append(_draw(title, f"course of {cause.label}", curves.time_min, items, shown=shown))
    return result


def experiment(proposed: Experiment, model: ProcessModel) -> list[Picture]:
    """Proposed input, outputs predicted by each explanation, and their differences."""
    curves = proposed.curves
    if curves is None:
        raise ValueError("an experiment without its curves cannot be drawn")
    first, item = next(iter(curves.outputs)), model.inputs[0]
    limits = {
        name: [Line(np.full(curves.time_min.size, end), "limit", "limits") for end in proposed.limits[name]]
        for name in (item.name, *model.output_names)
    }
    items = [Line(curves.level, "input", item.meaning, held=True), *limits[item.name]]
    result = [_draw(f"{item.name}, {item.unit}", f"proposed {item.name}", curves.time_min, items)]
    for name, unit in ((output.name, output.unit) for output in model.outputs):
        lines = [
            Line(columns[name], f"alternative{index}", label)
            for index, (label, columns) in enumerate(curves.outputs.items())
        ]
        title = f"{name}, {unit}, as predicted under each"
        result.append(_draw(title, f"predicted {name}", curves.time_min, [*lines, *limits[name]]))
        apart = [Line(line.values - lines[0].values, line.kind, line.text) for line in lines[1:]]
        title = f"{name}, {unit}, less what is predicted under {first}"
        result.append(_draw(title, f"differences of predicted {name}", curves.time_min, apart))
    return result


def law(diagnosis: Diagnosis) -> list[Picture]:
    """Missing term over each of its variables: the smooth curve with its 95 % band, and the formula."""
    if diagnosis.law is None:
        return []
    result = []
    for curve in diagnosis.law.curves:
        half = SD_95 * curve.smooth_sd
        ends = curve.smooth - half, curve.smooth + half
        items: list[Line | Band] = [
            Line(curve.smooth, "after", "smooth curve"),
            Band(*ends, "certain", "95 % interval"),
            Line(curve.formula, "limit", diagnosis.law.formula),
        ]
        title = f"Missing term{_unit(diagnosis.law.unit)}, over {curve.variable}"
        shown = _with_zero(curve.smooth, *ends)
        alternative = f"missing term over {curve.variable}"
        result.append(_draw(title, alternative, curve.values, items, shown=shown, unit=curve.unit))
    return result


def unknown_course(diagnosis: Diagnosis) -> list[Picture]:
    """Course of an unknown input, if there is one."""
    curves = _curves(diagnosis)
    unknown = curves.unknown
    if unknown is None:
        return []
    title, shown = f"Estimated as the size of: {unknown.label}{_unit(unknown.unit)}", _with_zero(*(unknown.size,) * 3)
    line = Line(unknown.size, "after", "most likely")
    return [_draw(title, "course of the unknown input", curves.time_min, [line], shown=shown)]


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


def _picture(diagnosis: Diagnosis, output: Output, simulations: Sequence[tuple[str, str]], rows: slice) -> Picture:
    """Measurements of an output and simulations by text and kind, all on the scale of both simulations."""
    curves, title = _curves(diagnosis), f"{output.name}, {output.unit}"
    measured, before, after = (
        columns[output.name][rows] for columns in (curves.measured, curves.simulated_before, curves.simulated_after)
    )
    models = np.concatenate([before, after, measured])
    finite = models[np.isfinite(models)]
    shown = (float(finite.min()), float(finite.max())) if finite.size else None
    lines = [Line(measured, "measured", "measured")]
    lines += [Line(after if text == EXTENDED else before, kind, text) for text, kind in simulations]
    alternative = f"{title}: {', '.join(line.text for line in lines)}"
    return _draw(title, alternative, curves.time_min[rows], lines, _onsets(diagnosis.causes), shown)


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
