"""Commands that run one node until it is finished or stopped: `plant`, `monitor`, `record`, `replay`."""

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from reactorwatch.cli.options import (
    MAX_WAIT_S,
    Columns,
    Diagnose,
    Endpoint,
    Inputs,
    Json,
    Outputs,
    Plant,
    Process,
    Reference,
    Settings,
    TrainingMin,
    TrainingRows,
    check_recording,
    choose_process,
    parse_columns,
    parse_pace,
    parse_span_ns,
    training_flags,
)
from reactorwatch.cli.printing import print_lines
from reactorwatch.cli.table_options import take_table_options
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("plant")(plant)
    app.command("monitor")(monitor)
    app.command("record")(record)
    app.command("replay")(take_table_options(replay))
    app.command("alive")(alive)


def _settings(path: Path | None, endpoint: str | None, *, quiet: bool = False) -> tuple[dict[str, dict[str, Any]], Any]:
    from reactorwatch.runtime.config import BusConfig, LogConfig, read_settings, section
    from reactorwatch.runtime.logs import configure

    tables = read_settings(path)
    log = section(LogConfig, "log", tables, {})
    configure(logging.WARNING if quiet else logging.INFO, as_json=log.format == "json")
    return tables, section(BusConfig, "bus", tables, {"endpoint": endpoint})


def _metrics(tables: dict[str, dict[str, Any]]) -> Any:
    from reactorwatch.runtime.config import MetricsConfig, section

    return section(MetricsConfig, "metrics", tables, {})


def plant(
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    preset: Annotated[
        str | None,
        typer.Option(help="Settings of a named run: fault-free, input-leakage, heat-transfer or reaction-rate."),
    ] = None,
    speed: Annotated[
        str | None, typer.Option(help="Plant time over wall time: a number, or 'max' [1].", show_default=False)
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", help="Minutes of plant time, then it ends [endless].", min=0)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the input and the noise.", show_default=False)] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            help="The inputs: random-steps, sines, square, constant or a record [random-steps].",
            show_default=False,
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(help="A fault, as cause:profile:size@onset: coolant_flow:step:-0.05@30min. Repeatable."),
    ] = None,
    process: Process = None,
) -> None:
    """Simulate a process with equations and publish its sensors' samples."""
    from plant_node.__main__ import run
    from reactorwatch.cli.plant_settings import load_plant_settings

    tables, bus = _settings(config, endpoint)
    flags = {
        "name": name,
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
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    training: TrainingMin = None,
    training_rows: TrainingRows = None,
    process: Process = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    reference: Reference = None,
    diagnose: Diagnose = None,
    state: Annotated[
        Path | None,
        typer.Option(
            "--state",
            help="Folder of the monitor's state, from which it resumes after a restart; made if it does not exist.",
            show_default=False,
        ),
    ] = None,
    plants: Annotated[
        str | None,
        typer.Option("--plants", help="Watch all of these plants: 'reactor/*', 'reactor/north_*'.", show_default=False),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            "--shard", help="With --plants: this monitor's part of them, such as 2/5 [1/1].", show_default=False
        ),
    ] = None,
) -> None:
    """Watch a plant, or a fleet of them: predict signals, raise alarms."""
    from contextlib import nullcontext

    from monitor_node.__main__ import run
    from monitor_node.config import MonitorConfig
    from monitor_node.fleet.config import FleetConfig
    from monitor_node.fleet.node import run as run_fleet
    from reactorwatch.cli.supervise import diagnosis_settings, run_diagnosis_node
    from reactorwatch.records.folder import make_folder
    from reactorwatch.runtime.config import LogConfig, section

    tables, bus = _settings(config, endpoint)
    choice = choose_process(process, inputs, outputs)
    flags: dict[str, Any] = {"plant": name, "process": choice.process, "reference": reference}
    if choice.outputs:
        flags |= {"inputs": list(choice.inputs), "outputs": list(choice.outputs)}
    flags |= training_flags(tables, training, training_rows)
    of_fleet = {"plants": plants, "shard": shard, "state": str(state) if state is not None else None}
    fleet = section(FleetConfig, "fleet", tables, of_fleet)
    if state is not None and fleet.plants is None:
        flags |= {"state_file": str(state / "monitor.state"), "alarm_state_file": str(state / "alarms.state")}
    config_of_monitor = section(MonitorConfig, "monitor", tables, flags)
    if fleet.plants is not None:
        state = Path(fleet.state) if fleet.state is not None else None
        for option, given in (("--plant", name), ("--diagnose", diagnose)):
            if given is not None:
                raise InputError(f"{option} is for the monitor of one plant; leave it out with --plants")
    if shard is not None and fleet.plants is None:
        raise InputError("--shard is a part of the plants that --plants names; give both")
    if state is not None:
        make_folder(state, "--state")
    if fleet.plants is not None:
        run_fleet(config_of_monitor, fleet, bus, _metrics(tables))
        return
    diagnosis = diagnosis_settings(tables, config_of_monitor, diagnose)
    with run_diagnosis_node(diagnosis, bus, section(LogConfig, "log", tables, {})) if diagnosis.out else nullcontext():
        run(config_of_monitor, bus, _metrics(tables))


def record(
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="File or folder to write to, made if it does not exist [.].", show_default=False
        ),
    ] = None,
) -> None:
    """Record everything on the bus into an MCAP file."""
    from reactorwatch.records.output import check_folder_name
    from reactorwatch.runtime.config import section
    from recorder.__main__ import run
    from recorder.config import RecorderConfig

    if out is not None and out.suffix != ".mcap":
        check_folder_name(out, "--out")
    tables, bus = _settings(config, endpoint)
    flags = {"plant": name, "out": str(out) if out is not None else None}
    run(section(RecorderConfig, "recorder", tables, flags), bus, _metrics(tables))


def replay(
    file: Annotated[
        Path, typer.Argument(help="A recording (.mcap), a folder of them, or a record (.csv).", show_default=False)
    ],
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Annotated[
        str | None, typer.Option("--plant", help="Publish it as this plant [as recorded].", show_default=False)
    ] = None,
    rate: Annotated[
        str | None, typer.Option(help="Times real time: a number, or 'max' [1].", show_default=False)
    ] = None,
    begin: Annotated[
        str | None, typer.Option("--from", help="Since the start, such as 10min [the start].", show_default=False)
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="Since the start, such as 20min [the end].", show_default=False)
    ] = None,
    loop: Annotated[bool | None, typer.Option("--loop", help="Restart at the end.", show_default=False)] = None,
    process: Process = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    column: Columns = None,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Publish nothing; run it through the monitor's core and compare the output with the recorded "
            "messages. Ends with 0 if all are equal, 1 if not.",
        ),
    ] = False,
    up: Annotated[
        bool, typer.Option("--up", help="Bring a router, a monitor and a recorder, as `up --record` does.")
    ] = False,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Publish a recording or a record as the plant did, or verify a recording.

    While it runs, `playback` pauses, resumes or steps it, or changes its rate; in a terminal, so do the keys space,
    right, up and down.
    """
    if verify:
        from reactorwatch.cli.verification import run

        given = {"--rate": rate, "--from": begin, "--to": end, "--loop": loop, "--column": column, "--process": process}
        given["--up"] = up
        for option, value in given.items():
            if value:
                raise InputError(f"--verify publishes nothing and takes the whole recording; leave out {option}")
        raise typer.Exit(run(check_recording(file), config, name, as_json=as_json))
    if up:
        from reactorwatch.cli.plant_settings import PlayedRecord
        from reactorwatch.cli.supervise import run_until_stopped

        part = {
            "--from": begin,
            "--to": end,
            "--loop": loop,
            "--column": column,
            "--input": inputs,
            "--output": outputs,
        }
        for option, value in part.items():
            if value:
                raise InputError(f"--up plays the whole file with its own names; leave out {option}")
        pace = {"name": name, "speed": parse_pace(rate, "--rate"), "process": process}
        played = PlayedRecord(check_recording(file), stated)
        raise typer.Exit(run_until_stopped(config, endpoint, None, pace, None, None, played))
    from reactorwatch.records.record import MINUTE_NS
    from reactorwatch.records.source_text import is_table
    from reactorwatch.runtime.config import section
    from recorder.tools.replay import ReplayConfig, run_replay

    if column and not is_table(file):
        raise InputError(f"--column is for the columns of a .csv file or another table, got {file}")
    choice = choose_process(process, inputs, outputs)
    tables, bus = _settings(config, endpoint)
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
        "table": {name: value for name, value in asdict(stated).items() if value not in (None, ())} or None,
    }
    run_replay(section(ReplayConfig, "replay", tables, flags), bus)


def alive(
    node: Annotated[str, typer.Argument(help="plant, monitor or recorder.", show_default=False)],
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for it.", min=0.1, max=MAX_WAIT_S)] = 5.0,
) -> None:
    """Check that a node is alive: ends with 0 or 1."""
    from reactorwatch.cli.liveliness import wait_for_node
    from reactorwatch.contract.keys import DEFAULT_PLANT

    _, bus = _settings(config, endpoint, quiet=True)
    there = wait_for_node(bus, name or DEFAULT_PLANT, node, timeout)
    print_lines(f"{node} is {'alive' if there else f'not there within {timeout:g} s'}")
    raise typer.Exit(0 if there else 1)
