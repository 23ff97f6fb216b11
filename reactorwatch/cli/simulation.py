"""`simulate`: simulate the plant along a record."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from plant_node.initial_state import complete_state
from reactorwatch.diagnosis.impossible_values import check_values
from reactorwatch.diagnosis.units import find_wrong_unit
from reactorwatch.errors import InputError
from reactorwatch.process import named_effects
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record, join_runs


def simulate_along(measured: Record, model: ProcessModel, faults: list[str]) -> Record:
    """Run the equations from the first row of each run of the record, driven by its input.

    Args:
        measured: record with the model's inputs and outputs as columns.
        model: the process; states without a column start at rest.
        faults: specifications of faults, with onsets in the record's time.

    Raises:
        InputError: the record cannot drive the model.
    """
    runs = measured.split_runs()
    simulated = join_runs([_simulate_run(run, model, faults, alone=len(runs) == 1) for run in runs])
    return replace(simulated, name=f"simulation of {measured.name}")


def _simulate_run(measured: Record, model: ProcessModel, faults: list[str], *, alone: bool) -> Record:
    """Simulate along one run of a record; a single row among other runs is returned unchanged."""
    for text in faults:
        model = parse_fault(text, named_effects(model)).extend(model, end_min=float(measured.time_min[-1]))
    wrong = find_wrong_unit(model, measured.columns, measured.time_min)
    if wrong is not None and not wrong.of_times:  # it may be short, and its rows far apart
        raise InputError(f"{measured.name}: {wrong.text}")
    check_values(measured, model)
    inputs = np.column_stack([measured.columns[name] for name in model.input_names])
    first = {name: float(measured.columns[name][0]) for name in model.output_names}
    if not np.all(np.isfinite(list(first.values()))):
        levels = ", ".join(f"{name} = {value:g}" for name, value in first.items())
        first_row = "the first row" if alone else "the first row of each run"
        raise InputError(
            f"{measured.name}: {first_row} must have {' and '.join(first)}, the run starts from them; got {levels}"
        )
    if not np.all(np.isfinite(inputs)):
        row = int(np.argmax(~np.all(np.isfinite(inputs), axis=1)))
        names = ", ".join(model.input_names)
        raise InputError(
            f"{measured.name}: {names} must be there in every row, it is missing at {measured.time_min[row]:g} min"
        )
    if measured.rows == 1 and not alone:
        return replace(measured, columns={name: measured.columns[name] for name in (*model.input_names, *first)})
    start = complete_state(model, first, inputs[0], float(measured.time_min[0]))
    try:
        trajectory = Simulator(model).run(measured.time_min, inputs, start)
    except ValueError as error:
        raise InputError(f"{measured.name}: {error}") from error
    columns = {name: inputs[:, index] for index, name in enumerate(model.input_names)}
    columns |= {name: trajectory.outputs[:, index] for index, name in enumerate(model.output_names)}
    return replace(measured, columns=columns)


def report(measured: Record, simulated: Record, model: ProcessModel, out: Path | None, *, as_json: bool) -> str:
    """Format the root mean square difference between simulation and record, by signal.

    Args:
        measured: the record.
        simulated: the simulation, in the rows of the record.
        model: the process.
        out: file of the simulation; None: it could not be written.
        as_json: format as a JSON object.
    """
    rmse, units = {}, model.units
    remarks = [sentence for law in model.laws for sentence in law.outside(simulated.columns)]
    for name in model.output_names:
        difference = simulated.columns[name] - measured.columns[name]
        rmse[name] = float(np.sqrt(np.nanmean(difference**2)))
    if as_json:
        result = {
            "file": None if out is None else str(out),
            "rows": measured.rows,
            "runs": len(measured.run_starts),
            "rmse": {name: {"value": value, "unit": units[name]} for name, value in rmse.items()},
            **({"remarks": remarks} if model.laws else {}),
        }
        return msgspec.json.encode(result).decode()
    parts = ", ".join(f"{name} {value:.3g} {units[name]}" for name, value in rmse.items())
    written = "not written" if out is None else f"wrote {out}"
    line = f"{written}: {measured.rows} rows; root mean square difference from the record: {parts}"
    return "\n".join([line, *(f"note: {remark}" for remark in [*measured.remarks, *remarks])])
