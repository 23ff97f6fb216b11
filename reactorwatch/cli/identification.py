"""`identify`: fit linear models to a record and format the results."""

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.families import Arx, Family, OutputError
from reactorwatch.identification.identify import Identification
from reactorwatch.identification.identify import identify as identify_model
from reactorwatch.identification.selection import Selection, select
from reactorwatch.identification.structure import ALL_ROWS, REPORT_ROWS
from reactorwatch.records.record import Record

INPUT = "qc"


def fit(
    measured: Record,
    output: str,
    model: str,
    order: int,
    delay: int,
    *,
    recursive: bool,
    report_rows: bool,
    as_json: bool,
) -> str:
    """Fit one model of one output and format it.

    Raises:
        InputError: the record or the options are unsuitable.
    """
    identification = identify_model(
        measured.continuous_min,
        *_columns(measured, output),
        model=model,
        order=order,
        delay=delay,
        output=output,
        recursive=recursive,
        choice=REPORT_ROWS if report_rows else ALL_ROWS,
        missing="leave out",
    )
    if as_json:
        return msgspec.json.encode(identification).decode()
    return f"{_text(identification, measured)}{_remarks_text(measured)}"


def compare(measured: Record, output: str, order: int, delay: int, *, neural: bool, as_json: bool) -> str:
    """Compare every family at every order up to `order`, and format the choice with its reason.

    Raises:
        InputError: as `fit`, or the extra for neural networks is not installed.
    """
    families: list[Family] = [Arx(), OutputError()]
    if neural:
        from reactorwatch.identification.neural import Neural

        families.append(Neural())
    if order < 1:
        raise InputError(f"order must be at least 1, got {order}")
    selection = select(
        *_columns(measured, output),
        measured.continuous_min,
        families=families,
        orders=range(1, order + 1),
        delay=delay,
    )
    if as_json:
        return _selection_json(selection, output)
    return f"{selection.table()}\n\n{selection.reason}{_remarks_text(measured)}"


def _remarks_text(measured: Record) -> str:
    return "".join(f"\nnote: {remark}" for remark in measured.remarks)


def _columns(measured: Record, output: str) -> tuple[Array, Array]:
    """Values of the input and of the output.

    Raises:
        InputError: there is no such output, or one of the two has no value.
    """
    if output not in ("C", "T"):
        raise InputError(f"--output must be C or T, got {output!r}")
    for signal in (INPUT, output):
        if not np.isfinite(measured.columns[signal]).any():
            raise InputError(f"{measured.name}: {signal} has no measured value, so no model of {output} can be fitted")
    return measured.columns[INPUT], measured.columns[output]


def _selection_json(selection: Selection, output: str) -> str:
    report = {
        "output": output,
        "candidates": selection.candidates,
        "chosen": {"family": selection.chosen.family, "order": selection.chosen.order} if selection.fits else None,
        "reason": selection.reason,
    }
    return msgspec.json.encode(report).decode()


def _text(found: Identification, measured: Record) -> str:
    unit = measured.units.get(found.output, "unit not known")
    names = [f"a{lag}" for lag in range(1, found.order + 1)] + [f"b{lag}" for lag in range(1, found.order + 1)]
    values = [*found.a, *found.b, found.offset]
    deviations = [*found.sd.a, *found.sd.b, found.sd.offset]
    past = "measured past" if found.model == "arx" else "model's own past"
    lines = [
        f"{found.model.upper()} of order {found.order}, delay {found.delay}: {found.output} ({unit}) from the {past} "
        f"and {INPUT}; {found.rows} rows fitted{', row by row' if found.recursive else ''}",
        "",
        *(
            f"  {name:<4}{value: .6g}  +- {deviation:.2g}"
            for name, value, deviation in zip([*names, "c"], values, deviations, strict=True)
        ),
        "",
        f"fit on the other half: one step {found.fit_percent.one_step:.2f} %, "
        f"free run {found.fit_percent.free_run:.2f} %",
        *(f"{name}: {result}" for name, result in found.checks.items()),
    ]
    return "\n".join(lines)
