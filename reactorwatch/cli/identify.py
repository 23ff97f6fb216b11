"""`identify`: fit models of the outputs of a record and format the results."""

from collections.abc import Sequence

import msgspec

from reactorwatch.cli.display import json_line
from reactorwatch.description.process import Process
from reactorwatch.description.read import DEFAULT_PROCESS, ProcessChoice, find_process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.identification.data import Dataset
from reactorwatch.identification.identify import Coefficients, Identification, ModelForm, identify
from reactorwatch.identification.selection import Selection, select
from reactorwatch.records.record import Record

NAMES = {
    "arx": "ARX",
    "oe": "OE",
    "armax": "ARMAX",
    "bj": "Box-Jenkins model",
    "narx": "polynomial NARX",
    "noe": "polynomial output-error",
}


def choose_outputs(
    process: str | None, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> tuple[Process, tuple[str, ...]]:
    """Process and the outputs that are identified."""
    default = find_process()
    if process is None and (inputs or not set(outputs) <= set(default.outputs)):
        described = ProcessChoice(None, inputs, outputs).load()
    else:
        described = ProcessChoice(process or DEFAULT_PROCESS, inputs).load()
    for output in outputs:
        if output not in described.outputs:
            raise InputError(describe_unknown("--output", output, described.outputs))
    return described, outputs or described.watch.identified or described.outputs


def fit(
    measured: Record,
    inputs: Sequence[str],
    outputs: Sequence[str],
    form: ModelForm,
    held_out: Record | None = None,
    settle: int = 0,
    *,
    as_json: bool,
) -> str:
    """Fit one model of each output and format them, as JSON one object a line."""
    found = []
    for output in outputs:
        validated = None if held_out is None else Dataset.of_record(held_out, inputs, output)
        found.append(identify(Dataset.of_record(measured, inputs, output), form, validated, settle))
    if as_json:
        return "\n".join(json_line(item) for item in found)
    other = None if held_out is None else held_out.name
    return "\n\n".join(_text(item, inputs, measured, other) for item in found) + _remarks_text(measured)


def compare(
    measured: Record,
    inputs: Sequence[str],
    outputs: Sequence[str],
    form: ModelForm,
    *,
    as_json: bool,
) -> str:
    """Compare every family at every order up to that of the form, and format the choice for each output."""
    if form.order < 1:
        raise InputError(f"order must be at least 1, got {form.order}")
    orders, texts = range(1, form.order + 1), []
    for output in outputs:
        data = Dataset.of_record(measured, inputs, output)
        data.split(data.rows // 2)[0].check_movement()
        selection = select(*data.arrays, orders=orders, delay=form.delay)
        text = f"{selection.table()}\n\n{selection.reason}"
        heading = f"{output}\n" if len(outputs) > 1 else ""
        texts.append(_selection_json(selection, output) if as_json else f"{heading}{text}")
    return "\n".join(texts) if as_json else "\n\n".join(texts) + _remarks_text(measured)


def _remarks_text(measured: Record) -> str:
    return "".join(f"\nnote: {remark}" for remark in measured.remarks)


def _selection_json(selection: Selection, output: str) -> str:
    report = {
        "output": output,
        "candidates": selection.candidates,
        "chosen": {"family": selection.chosen.family, "order": selection.chosen.order} if selection.fits else None,
        "reason": selection.reason,
    }
    return json_line(report)


def _text(found: Identification, inputs: Sequence[str], measured: Record, other: str | None) -> str:
    unit = measured.units.get(found.output, "unit not known")
    past = "model's own past" if found.model == "oe" else "measured past"
    rows = f"{found.rows} rows fitted{', row by row' if found.recursive else ''}"
    error = "" if found.rmse is msgspec.UNSET else f" (root mean square error {found.rmse.free_run:.4g})"
    lines = [
        f"{NAMES[found.model]} of order {found.order}, delay {found.delay}: {found.output} ({unit}) from the "
        f"{' and '.join((past, *inputs))}; {rows}",
        "",
        *_parameter_lines(found),
        "",
        f"fit on {other or 'the other half'}: one step {found.fit_percent.one_step:.2f} %, "
        f"free run {found.fit_percent.free_run:.2f} %{error}",
        *(f"{name}: {result}" for name, result in found.checks.items()),
    ]
    return "\n".join(lines)


def _parameter_lines(found: Identification) -> list[str]:
    """One line a parameter, with its standard deviation."""
    sd = found.sd
    groups: list[tuple[str, Coefficients, Coefficients]] = [("a", found.a, sd.a)]
    if isinstance(found.b, dict):
        assert isinstance(sd.b, dict)
        groups += [(f"b.{name}.", values, sd.b[name]) for name, values in found.b.items()]
    else:
        assert not isinstance(sd.b, dict)
        groups.append(("b", found.b, sd.b))
    pairs = [(f"{name}{lag}", *pair) for name, *both in groups for lag, pair in enumerate(zip(*both, strict=True), 1)]
    pairs.append(("offset", found.offset, sd.offset))
    pairs += [(item.term, item.value, item.sd) for item in ([] if found.terms is msgspec.UNSET else found.terms)]
    for name in ("c", "d", "f"):
        values, deviations = getattr(found, name), getattr(sd, name)
        if values is not msgspec.UNSET:
            pairs += [(f"{name}{lag}", *pair) for lag, pair in enumerate(zip(values, deviations, strict=True), 1)]
    width = max(len(name) for name, *_ in pairs) + 2
    return [f"  {name:<{width}}{value: .6g}  +- {deviation:.2g}" for name, value, deviation in pairs]
