"""`identify`: fit models of the outputs of a record and format the results."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from reactorwatch.cli.display import json_line
from reactorwatch.description.process import Process
from reactorwatch.description.read import ProcessChoice, find_process
from reactorwatch.errors import InputError, UnfitRecordError, describe_unknown
from reactorwatch.identification.data import Dataset
from reactorwatch.identification.dead_time import DelayChoice, name_delays, resolve_delay
from reactorwatch.identification.identify import ModelForm, identify
from reactorwatch.identification.selection import Candidate, Selection, select
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.records.record import Record
from reactorwatch.sentences.models import identification_text, notes_text


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
        return "\n".join(json_line(item.to_dict()) for item in found)
    other, units = None if held_out is None else held_out.name, measured.units
    texts = (identification_text(item, inputs, units.get(item.output, "unit not known"), other) for item in found)
    return "\n\n".join(texts) + notes_text(measured.remarks)


def compare(
    measured: Record,
    inputs: Sequence[str],
    outputs: Sequence[str],
    order: int,
    delay: DelayChoice,
    *,
    as_json: bool,
) -> str:
    """Compare every family at every order up to one, and format the choice for each output.

    With `auto` a delay of 1 is compared with the dead times that are found, where the rows suffice for the search.
    """
    if order < 1:
        raise InputError(f"order must be at least 1, got {order}")
    orders, texts = range(1, order + 1), []
    for output in outputs:
        data = Dataset.of_record(measured, inputs, output)
        fitted, _ = data.split(data.rows // 2)
        fitted.check_movement()
        try:
            found = resolve_delay(delay, fitted)
        except UnfitRecordError:
            found = 1
        delays = [found] if delay != "auto" or set(np.atleast_1d(found)) == {1} else [1, found]
        selection = select(*data.arrays, orders=orders, delays=delays)
        text = f"{selection.table()}\n\n{selection.reason}"
        heading = f"{output}\n" if len(outputs) > 1 else ""
        texts.append(_selection_json(selection, data) if as_json else f"{heading}{text}")
    return "\n".join(texts) if as_json else "\n\n".join(texts) + notes_text(measured.remarks)


def read_delay(text: str) -> DelayChoice:
    """Delay of the command line: a number, `auto`, or `u1=3,u2=15`."""
    try:
        if "=" in text:
            pairs = (part.rpartition("=") for part in text.split(","))
            return {name.strip(): int(value) for name, _, value in pairs}
        return text if text == "auto" else int(text)
    except ValueError:
        raise InputError(f"--delay must be a number of samples, auto, or u1=3,u2=15, got {text!r}") from None


def _selection_json(selection: Selection, data: Dataset) -> str:
    def as_item(candidate: Candidate) -> dict[str, Any]:
        return msgspec.structs.asdict(candidate) | {"delay": name_delays(candidate.delay, data.input_names)}

    chosen = as_item(selection.chosen)
    report = {
        "output": data.output_name,
        "candidates": [as_item(candidate) for candidate in selection.candidates],
        "chosen": {name: chosen[name] for name in ("family", "order", "delay")} if selection.fits else None,
        "reason": selection.reason,
    }
    return json_line(report)
