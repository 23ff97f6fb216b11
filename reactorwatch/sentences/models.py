"""An identified model and a simulation in words."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reactorwatch.identification.identify import Identification
    from reactorwatch.results.simulation import SimulationReport

NAMES = {
    "arx": "ARX",
    "oe": "OE",
    "armax": "ARMAX",
    "bj": "Box-Jenkins model",
    "narx": "polynomial NARX",
    "noe": "polynomial output-error",
}


def identification_headline(found: "Identification") -> str:
    """Model and fits in a line."""
    return (
        f"{found.model} of order {found.order}, delay {delay_text(found)}, for {found.output}: "
        f"free run {free_run_text(found)}, one step {found.fit_percent.one_step:.2f} %"
    )


def free_run_text(found: "Identification") -> str:
    """Fit of the simulation, in per cent."""
    percent = found.fit_percent.free_run
    return "diverges" if percent == -math.inf else f"{percent:.2f} %"


def delay_text(found: "Identification") -> str:
    """Delay in rows, of each input where they differ."""
    delay = found.delay
    return str(delay) if isinstance(delay, int) else ", ".join(f"{name} {rows}" for name, rows in delay.items())


def identification_text(
    found: "Identification", inputs: Sequence[str], unit: str, validated_on: str | None = None
) -> str:
    """Model, parameters with their standard deviations, fit and checks, as lines for a terminal.

    Args:
        found: the model.
        inputs: names of its inputs.
        unit: unit of its output.
        validated_on: name of the record that it was validated on; None: the other half of its own.
    """
    past = "model's own past" if found.model == "oe" else "measured past"
    rows = f"{found.rows} rows fitted{', row by row' if found.recursive else ''}"
    error = "" if found.rmse is None else f" (root mean square error {found.rmse.free_run:.4g})"
    lines = [
        f"{NAMES[found.model]} of order {found.order}, delay {delay_text(found)}: {found.output} ({unit}) from the "
        f"{' and '.join((past, *inputs))}; {rows}",
        "",
        *_parameter_lines(found),
        "",
        f"fit on {validated_on or 'the other half'}: one step {found.fit_percent.one_step:.2f} %, "
        f"free run {free_run_text(found)}{error}",
        *(f"{name}: {result}" for name, result in found.checks.items()),
    ]
    return "\n".join(lines)


def _parameter_lines(found: "Identification") -> list[str]:
    """One line a parameter, with its standard deviation."""
    sd = found.sd
    groups: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = [("a", found.a, sd.a)]
    if isinstance(found.b, dict):
        assert isinstance(sd.b, dict)
        groups += [(f"b.{name}.", values, sd.b[name]) for name, values in found.b.items()]
    else:
        assert not isinstance(sd.b, dict)
        groups.append(("b", found.b, sd.b))
    pairs = [(f"{name}{lag}", *pair) for name, *both in groups for lag, pair in enumerate(zip(*both, strict=True), 1)]
    pairs.append(("offset", found.offset, sd.offset))
    pairs += [(item.term, item.value, item.sd) for item in found.terms or ()]
    for name in ("c", "d", "f"):
        values, deviations = getattr(found, name), getattr(sd, name)
        if values is not None:
            pairs += [(f"{name}{lag}", *pair) for lag, pair in enumerate(zip(values, deviations, strict=True), 1)]
    width = max(len(name) for name, *_ in pairs) + 2
    return [f"  {name:<{width}}{value: .6g}  +- {deviation:.2g}" for name, value, deviation in pairs]


def simulation_text(report: "SimulationReport") -> str:
    """File, rows and differences of a simulation, and remarks."""
    parts = ", ".join(f"{name} {item.value:.3g} {item.unit}" for name, item in report.rmse.items())
    written = "not written" if report.file is None else f"wrote {report.file}"
    line = f"{written}: {report.rows} rows; root mean square difference from the record: {parts}"
    return line + notes_text([*report.notes, *(report.remarks or ())])


def notes_text(notes: Iterable[str]) -> str:
    """A line for each note."""
    return "".join(f"\nnote: {note}" for note in notes)
