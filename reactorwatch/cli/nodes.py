"""Commands that run one node until it is finished or stopped: `plant`, `monitor`, `record`, `replay`."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from reactorwatch.cli.option_groups import TableOptions, stated_settings
from reactorwatch.cli.options import (
    Begin,
    BusOptions,
    Columns,
    Diagnose,
    End,
    Json,
    PlantOptions,
    Process,
    ProcessOptions,
    Recording,
    Reference,
    Seed,
    Speed,
    TrainingOptions,
    check_recording,
    parse_columns,
    parse_pace,
    parse_span_ns,
)
from reactorwatch.errors import InputError


def _settings(target: BusOptions) -> tuple[dict[str, dict[str, Any]], Any]:
    from reactorwatch.runtime.config import BusConfig, LogConfig, read_settings, section
    from reactorwatch.runtime.logs import configure

    tables = read_settings(target.config)
    configure(as_json=section(LogConfig, "log", tables, {}).format == "json")
    return tables, section(BusConfig, "bus", tables, {"endpoint": target.endpoint})


def _metrics(tables: dict[str, dict[str, Any]]) -> Any:
    from reactorwatch.runtime.config import MetricsConfig, section

    return section(MetricsConfig, "metrics", tables, {})


def plant(
    *,
    target: PlantOptions,
    preset: Annotated[
        str | None, Option(help="Settings of a named run: fault-free, input-leakage, heat-transfer or reaction-rate.")
    ] = None,
    speed: Speed = None,
    duration: Annotated[float | None, Option(help="Minutes of plant time, then it ends [endless].", min=0)] = None,
    seed: Seed = None,
    scenario: Annotated[
        str | None, Option(help="The inputs: random-steps, sines, square, constant or a record [random-steps].")
    ] = None,
    fault: Annotated[
        list[str] | None,
        Option(help="A fault, as cause:profile:size@onset: coolant_flow:step:-0.05@30min. Repeatable."),
    ] = None,
    process: Process = None,
) -> None:
    """Simulate a process with equations and publish its sensors' samples."""
    from plant_node.__main__ import run
    from reactorwatch.cli.plant_settings import load_plant_settings

    tables, bus = _settings(target)
    flags = {
        "name": target.name,
        "preset": preset,
        "speed": parse_pace(speed, "--speed"),
        "duration_min": duration,
        "seed": seed,
        "scenario": scenario,
        "faults": fault or None,
        "process": process,
    }
    run(load_plant_settings(tables, flags), bus, _metrics(tables))


def monitor(
    *,
    target: PlantOptions,
    training: TrainingOptions,
    chosen: ProcessOptions,
    reference: Reference = None,
    diagnose: Diagnose = None,
    state: Annotated[
        Path | None,
        Option(help="Folder of the monitor's state, from which it resumes after a restart; made if it does not exist."),
    ] = None,
    plants: Annotated[str | None, Option(help="Watch all of these plants: 'reactor/*', 'reactor/north_*'.")] = None,
    shard: Annotated[str | None, Option(help="With --plants: this monitor's part of them, such as 2/5 [1/1].")] = None,
) -> None:
    """Watch a plant, or a fleet of them: predict signals, raise alarms."""
    from contextlib import nullcontext

    from monitor_node.__main__ import run
    from monitor_node.config import MonitorConfig
    from monitor_node.fleet.config import FleetConfig
    from reactorwatch.cli.kernels import compile_at_first_start
    from reactorwatch.cli.supervise import diagnosis_settings, run_diagnosis_node
    from reactorwatch.records.write import check_folder_name
    from reactorwatch.runtime.config import LogConfig, section

    tables, bus = _settings(target)
    choice = chosen.choose()
    flags: dict[str, Any] = {"plant": target.name, "process": choice.process, "reference": reference}
    if choice.outputs:
        flags |= {"inputs": list(choice.inputs), "outputs": list(choice.outputs)}
    flags |= training.flags(tables)
    of_fleet = {"plants": plants, "shard": shard, "state": str(state) if state is not None else None}
    fleet = section(FleetConfig, "fleet", tables, of_fleet)
    if state is not None and fleet.plants is None:
        flags["state_file"] = str(state / "monitor.state")
    config_of_monitor = section(MonitorConfig, "monitor", tables, flags)
    if fleet.plants is not None:
        state = Path(fleet.state) if fleet.state is not None else None
        for option, given in (("--plant", target.name), ("--diagnose", diagnose)):
            if given is not None:
                raise InputError(f"{option} is for the monitor of one plant; leave it out with --plants")
    if shard is not None and fleet.plants is None:
        raise InputError("--shard is a part of the plants that --plants names; give both")
    if state is not None:
        check_folder_name(state, "--state")
    compile_at_first_start()
    if fleet.plants is not None:
        run(config_of_monitor, bus, _metrics(tables), fleet)
        return
    diagnosis = diagnosis_settings(tables, config_of_monitor, diagnose)
    with run_diagnosis_node(diagnosis, bus, section(LogConfig, "log", tables, {})) if diagnosis.out else nullcontext():
        run(config_of_monitor, bus, _metrics(tables), state=state)


def record(
    *,
    target: PlantOptions,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File or folder to write to, made if it does not exist [.].")
    ] = None,
) -> None:
    """Record everything on the bus into an MCAP file."""
    from reactorwatch.records.write import check_folder_name
    from reactorwatch.runtime.config import section
    from recorder.__main__ import run
    from recorder.config import RecorderConfig

    if out is not None and out.suffix != ".mcap":
        check_folder_name(out, "--out")
    tables, bus = _settings(target)
    flags = {"plant": target.name, "out": str(out) if out is not None else None}
    run(section(RecorderConfig, "recorder", tables, flags), bus, _metrics(tables))


def replay(
    *,
    file: Recording,
    target: BusOptions,
    name: Annotated[str | None, Option("--plant", help="Publish it as this plant [as recorded].")] = None,
    rate: Annotated[str | None, Option(help="Times real time: a number, or 'max' [1].")] = None,
    begin: Begin = None,
    end: End = None,
    loop: Annotated[bool | None, Option("--loop", help="Restart at the end.")] = None,
    chosen: ProcessOptions,
    column: Columns = None,
    verify: Annotated[
        bool,
        Option(
            "--verify",
            help="Publish nothing; run it through the monitor's core and compare the output with the recorded "
            "messages. Ends with 0 if all are equal, 1 if not.",
        ),
    ] = False,
    up: Annotated[
        bool, Option("--up", help="Bring a router, a monitor and a recorder, as `up --record` does.")
    ] = False,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Publish a recording or a record as the plant did, or verify a recording.

    In a terminal the keys space, right, up and down pause and resume it, step it, and change its rate.
    """
    part = {"--from": begin, "--to": end, "--loop": loop, "--column": column}
    if verify:
        from reactorwatch.cli.verification import run

        given = {"--rate": rate, **part, "--input": chosen.inputs, "--output": chosen.outputs, "--up": up}
        _refuse(given, "--verify publishes nothing and takes the whole recording")
        raise typer.Exit(run(check_recording(file), target.config, name, chosen.process, as_json=as_json))
    if up:
        from reactorwatch.cli.plant_settings import PlayedRecord
        from reactorwatch.cli.supervise import run_until_stopped

        _refuse(
            {**part, "--input": chosen.inputs, "--output": chosen.outputs},
            "--up plays the whole file with its own names",
        )
        pace = {"name": name, "speed": parse_pace(rate, "--rate"), "process": chosen.process}
        played = PlayedRecord(check_recording(file), table.stated)
        raise typer.Exit(run_until_stopped(target, None, pace, None, None, played))
    from reactorwatch.records.decode import is_table
    from reactorwatch.records.record import MINUTE_NS
    from reactorwatch.runtime.config import section
    from recorder.config import ReplayConfig
    from recorder.tools.replay import run_replay

    if column and not is_table(file):
        raise InputError(f"--column is for the columns of a .csv file or another table, got {file}")
    choice = chosen.choose()
    tables, bus = _settings(target)
    flags = {
        "file": str(check_recording(file)),
        "plant": name,
        "rate": parse_pace(rate, "--rate"),
        "from_min": parse_span_ns(begin, "--from") / MINUTE_NS if begin is not None else None,
        "to_min": parse_span_ns(end, "--to") / MINUTE_NS if end is not None else None,
        "loop": loop,
        "process": choice.process,
        "inputs": choice.inputs or None,
        "outputs": choice.outputs or None,
        "columns": parse_columns(column) or None,
        "table": stated_settings(table.stated),
    }
    run_replay(section(ReplayConfig, "replay", tables, flags), bus)


def _refuse(given: dict[str, Any], why: str) -> None:
    """Refuse options that are given beside one which excludes them."""
    for option, value in given.items():
        if value:
            raise InputError(f"{why}; leave out {option}")
