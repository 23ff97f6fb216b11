"""Commands for a running plant: up, plant, monitor, status, view; `alarm.py` has alarm and baseline."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from reactorwatch.cli.display import print_lines
from reactorwatch.cli.option_groups import (
    ClientOptions,
    PlantOptions,
    ProcessOption,
    ProcessOptions,
    TableOptions,
    TrainingOptions,
)
from reactorwatch.cli.options import MAX_WAIT_S, Diagnose, Json, Reference, Seed, Site, Speed, parse_pace
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS

if TYPE_CHECKING:
    from monitor_node.config import MonitorConfig
    from monitor_node.fleet import FleetConfig
    from reactorwatch.description.read import ProcessChoice
    from reactorwatch.runtime.config import BusConfig


def up(
    *,
    target: PlantOptions,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for the recording, or its file [as in the settings, or runs].")
    ] = None,
    speed: Speed = None,
    seed: Seed = None,
    fault: Annotated[list[str] | None, Option(help="A fault, as cause:profile:size@onset. Repeatable.")] = None,
    chosen: ProcessOptions,
    record: Annotated[
        Path | None, Option(help="Play this record (a recording or a table) in place of a simulated plant.")
    ] = None,
    diagnose: Diagnose = None,
    site: Site = None,
    table: TableOptions,
) -> None:
    """Run router, plant, monitor and recorder until stopped.

    With --record a record is played in place of the simulated plant; the run ends with it.
    """
    from reactorwatch.cli.plant_settings import PlayedRecord
    from reactorwatch.cli.up import run_until_stopped

    flags = {
        "name": target.name,
        "speed": parse_pace(speed, "--speed"),
        "seed": seed,
        "faults": fault or None,
    }
    choice = chosen.choose()
    if record is None and (table.file_format != GUESS or choice.outputs):
        raise InputError("options about the form of a table are for the record of --record; name it, or leave them out")
    played = None if record is None else PlayedRecord(record, table.file_format)
    with describe_in_file(choice) as named:
        flags["process"] = named
        raise typer.Exit(run_until_stopped(target, out, flags, diagnose, site, played))


@contextmanager
def describe_in_file(choice: "ProcessChoice") -> Iterator[str | None]:
    """Process as settings of nodes name it: columns alone are described in a file, for as long as the nodes run."""
    if not choice.outputs:
        yield choice.process
        return
    import tomli_w

    from reactorwatch.description.toml_file import to_tables

    with TemporaryDirectory(prefix="reactorwatch-") as folder:
        path = Path(folder) / "process.toml"
        path.write_text(tomli_w.dumps(to_tables(choice.load())), encoding="utf-8")
        yield str(path)


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
    chosen: ProcessOption,
) -> None:
    """Simulate a process with equations and publish its sensors' samples."""
    from plant_node.__main__ import run
    from reactorwatch.cli.bus_client import metrics_settings, node_settings
    from reactorwatch.cli.plant_settings import load_plant_settings

    tables, bus = node_settings(target)
    flags = {
        "name": target.name,
        "preset": preset,
        "speed": parse_pace(speed, "--speed"),
        "duration_min": duration,
        "seed": seed,
        "scenario": scenario,
        "faults": fault or None,
        "process": chosen.process,
    }
    run(load_plant_settings(tables, flags), bus, metrics_settings(tables))


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
    shards: Annotated[
        int | None, Option(help="With --plants and --scheduler: watch them by so many monitors, a shard each.")
    ] = None,
    scheduler: Annotated[
        str | None, Option(help="With --shards: Dask cluster on which they run, such as tls://10.0.0.3:8786.")
    ] = None,
) -> None:
    """Watch a plant, or a fleet of them: predict signals, raise alarms."""
    from contextlib import nullcontext

    from monitor_node.__main__ import run
    from monitor_node.config import MonitorConfig
    from monitor_node.fleet import FleetConfig
    from monitor_node.watched_process import load_process
    from reactorwatch.cli.bus_client import metrics_settings, node_settings
    from reactorwatch.cli.kernels import compile_at_first_start, is_first_start
    from reactorwatch.cli.up import diagnosis_settings, run_diagnosis_node
    from reactorwatch.records.write import check_folder_name
    from reactorwatch.runtime.config import LogConfig, section

    tables, bus = node_settings(target)
    choice = chosen.choose()
    flags: dict[str, Any] = {"plant": target.name, "process": choice.process, "reference": reference}
    if choice.outputs:
        flags |= {"inputs": list(choice.inputs), "outputs": list(choice.outputs)}
    flags |= training.flags(tables)
    of_fleet = {
        "plants": plants,
        "shard": shard,
        "state": str(state) if state is not None else None,
        "shards": shards,
        "scheduler": scheduler,
    }
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
    if fleet.shards is not None or scheduler is not None:
        if shard is not None:
            raise InputError("--shard is one part of the plants, and --shards are all of them; give one of both")
        place_shards(tables, bus, config_of_monitor, fleet)
        return
    if is_first_start() and fleet.plants is None:
        load_process(config_of_monitor)  # its errors are not half a minute late
    compile_at_first_start()
    if fleet.plants is not None:
        run(config_of_monitor, bus, metrics_settings(tables), fleet)
        return
    diagnosis = diagnosis_settings(tables, config_of_monitor, diagnose)
    with run_diagnosis_node(diagnosis, bus, section(LogConfig, "log", tables, {})) if diagnosis.out else nullcontext():
        run(config_of_monitor, bus, metrics_settings(tables), state=state)


def place_shards(
    tables: dict[str, dict[str, Any]], bus: "BusConfig", config: "MonitorConfig", fleet: "FleetConfig"
) -> None:
    """Keep the shards of a fleet running on a Dask cluster; workers see files under the same paths as this machine."""
    from msgspec.structs import replace

    from monitor_node.fleet import Shard, load_kinds
    from monitor_node.placement import cluster_security, place
    from reactorwatch.cli.bus_client import metrics_settings
    from reactorwatch.cli.processes import settings_text
    from reactorwatch.runtime.config import IDENTITY, LogConfig, section
    from reactorwatch.runtime.event_loop import stop_on_signals

    needed = {
        "--plants": fleet.plants,
        "--shards": fleet.shards,
        "--scheduler": fleet.scheduler,
        "--state": fleet.state,
    }
    for option, given in needed.items():
        if given is None:
            raise InputError(
                "shards on a cluster need --plants, --shards, --scheduler and --state (a folder that all workers see): "
                f"add {option}"
            )
    load_kinds(fleet.share_promise(config), fleet)  # errors in the settings are those of this command
    cluster_security(fleet, bus)

    def absolute(name: str | None) -> str | None:
        return str(Path(name).absolute()) if name is not None and Path(name).is_file() else name

    bus = replace(bus, **{name: absolute(getattr(bus, name)) for name in IDENTITY})
    config = replace(config, process=absolute(config.process))
    fleet = replace(fleet, processes={plants: str(absolute(name)) for plants, name in fleet.processes.items()})
    others = {"metrics": metrics_settings(tables), "log": section(LogConfig, "log", tables, {})}
    folder, count = Path(str(fleet.state)).absolute(), int(fleet.shards or 1)
    settings = {}
    for shard in (str(Shard(number, count)) for number in range(1, count + 1)):
        own = replace(fleet, shard=shard, shards=None, identity=None, state=str(folder / shard.replace("/", "-of-")))
        settings[shard] = settings_text({"bus": bus, "monitor": config, "fleet": own, **others})
    with stop_on_signals() as stop:
        place(fleet, bus, settings, stop)


def status(
    *,
    nodes: Annotated[
        list[str] | None, Argument(help="With --check: these nodes, or shards such as 2/5 [all that publish health].")
    ] = None,
    target: ClientOptions,
    chosen: ProcessOption,
    check: Annotated[
        bool, Option("--check", help="Check that nodes are alive, and nothing else. Ends with 0 if all are, 1 if not.")
    ] = False,
    once: Annotated[bool, Option("--once", help="Show it once.")] = False,
    seconds: Annotated[float, Option(help="How long to listen before showing it once.", min=0.1, max=MAX_WAIT_S)] = 4.0,
    as_json: Json = False,
) -> None:
    """Show the current state of plants, nodes, rates and alarms, until stopped; or check that nodes are alive."""
    from reactorwatch.cli.bus_client import is_for_all_plants, load_recorder_settings, observed_process
    from reactorwatch.cli.status import check_alive, run

    bus, recorder = load_recorder_settings(target)
    if check:
        raise typer.Exit(check_alive(bus, recorder.plant, tuple(nodes or ()), target.timeout, as_json=as_json))
    if nodes:
        raise InputError(f"{nodes[0]}: nodes are named for --check alone; give it, or leave them out")
    described = observed_process(chosen.process, recorder)
    # with a certificate for one plant, messages of others are not received
    is_one = target.name is not None or (bus.ca is not None and not is_for_all_plants(bus))
    run(bus, recorder.plant if is_one else None, seconds, described, once=once, as_json=as_json)


LOOPBACK = "127.0.0.1"


def view(
    *,
    target: PlantOptions,
    chosen: ProcessOption,
    web: Annotated[bool, Option("--web", help="In the browser, at the address that is printed.")] = False,
    bind: Annotated[str, Option(help="The address that the viewer listens on.")] = LOOPBACK,
    port: Annotated[
        int | None,
        Option(
            help="For the browser; the one after it carries the data [two that are free].",
            min=1024,
            max=65534,
        ),
    ] = None,
) -> None:
    """Show a running plant live: a window, or with --web a page for the browser.

    Ends when the window is closed or with Ctrl-C. The last minute before the start is shown, too.
    """
    import logging
    from dataclasses import replace

    from reactorwatch.cli.bus_client import check_one_plant, load_recorder_settings, observed_process
    from reactorwatch.description.read import find_process
    from recorder.view.viewer import DisplayTarget, show

    if chosen.process is not None and target.config is None:
        target = replace(target, name=target.name or find_process(chosen.process).name)
    bus, recorder = load_recorder_settings(target, logging.INFO)
    check_one_plant(bus, target.name)
    described = observed_process(chosen.process, recorder)
    show(recorder.plant, bus, DisplayTarget(web=web, bind=bind, port=port), print_lines, described)
