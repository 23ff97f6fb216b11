"""The recorder as a process: `python -m recorder [settings.toml]`."""

import sys
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

import msgspec
import tomli_w

from reactorwatch.contract import keys
from reactorwatch.description.plants import PlantProcesses
from reactorwatch.errors import InputError, is_passing
from reactorwatch.records.folder import make_folder
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import instance_name, join, wait_ready
from recorder.config import RecorderConfig
from recorder.core import COMMANDS, NODE, PRIORITIES, Recorder
from recorder.files.ages import BootClock, read_boot_clock
from recorder.files.part_file import PartFile
from recorder.keep import DAY_NS, BlackBox, ChannelBudget, FileNames, FlushAndRotation, LatchedMessages, Limits
from recorder.node import Policies, RecorderNode
from recorder.recording_files import RecordingFiles, free_bytes

HISTORY_MARGIN_NS = 10_000_000_000
"""Largest delay from publication, which dates a message on the bus, to receipt, which dates it in a file."""

_MB = 1_000_000


def run(
    config: RecorderConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Record until SIGINT (Ctrl-C) or SIGTERM; the file is closed in every case.

    Args:
        config: settings of the recorder.
        bus_config: settings of the bus.
        metrics_config: settings of the metrics endpoint.

    Raises:
        InputError: the folder cannot be made; the file exists or cannot be written; or the endpoint is invalid.
    """
    with stop_on_signals() as stop:
        record(config, bus_config, stop, metrics_config)


def record(
    config: RecorderConfig,
    bus_config: BusConfig,
    stop: StopSignal,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> Path | None:
    """Record until `stop` is set.

    Returns:
        The last file; None if no router was found before the stop, or the disk was full at the end.

    Raises:
        InputError: as `run`.
    """
    history_ns = round(bus_config.history_s * 1e9) + HISTORY_MARGIN_NS

    def start() -> tuple[RecordingFiles, RecorderNode]:
        files, start_ns = open_files(config), time.time_ns()
        fingerprints = files.fingerprints_since(start_ns - history_ns)
        return files, start_node(config, files, start_ns, fingerprints, fingerprints_until_ns=start_ns + history_ns)

    try:  # errors in the settings are raised before waiting for a router
        open_files(config)
    except (InputError, OSError) as error:
        if not is_passing(error):
            raise
    page = Metrics(NODE, {config.plant: lambda: node.alarms()}, partial(free_bytes, file_names(config).folder))
    token = keys.instance_token(config.plant, NODE, instance_name())
    with serve_metrics(metrics_config, page) as metrics, join(bus_config, NODE, stop, token) as bus:
        started = None if bus is None else wait_ready(start, bus, NODE, config.plant, stop)
        if bus is None or started is None:
            return None
        files, node = started
        with files:
            on_publish = metrics.on_publish if metrics is not None else None
            loop = EventLoop(node, bus, stop, drain_timeout_s=config.linger_s, on_publish=on_publish)
            loop.subscribe(config.key_expression, history_s=bus_config.history_s, on_gap=node.on_gap)
            loop.accept_commands(*(keys.key(config.plant, keys.COMMAND, name) for name in COMMANDS))
            bus.declare_token(keys.key(config.plant, keys.ALIVE, NODE))
            loop.run()
            return files.path


def open_files(
    config: RecorderConfig,
    open_part: Callable[[Path], PartFile] = PartFile,
    read_clock: Callable[[], BootClock] = read_boot_clock,
) -> RecordingFiles:
    """Recording files of the settings, whose folder is made if it does not exist.

    Args:
        config: the settings.
        open_part: see `RecordingFiles`.
        read_clock: see `RecordingFiles`.

    Raises:
        InputError: as `run`.
    """
    names = file_names(config)
    if names.dated and not names.folder.suffix[1:].isalpha():  # run.csv is a file of another kind, not a folder's name
        make_folder(names.folder, "--out")
    metadata = {
        "plant": config.plant,
        "key_expression": config.key_expression,
        "configuration": tomli_w.dumps(msgspec.to_builtins(config)),
        **config.about,
    }
    limits = Limits(config.keep_mb * _MB, config.keep_days * DAY_NS, config.keep_files)
    synced = config.fsync != "never"
    return RecordingFiles(
        names,
        metadata,
        limits,
        synced=synced,
        open_part=open_part,
        read_clock=read_clock,
        find_process=PlantProcesses(config.processes).find,
    )


def start_node(
    config: RecorderConfig,
    files: RecordingFiles,
    start_ns: int,
    fingerprints: Collection[int] = (),
    fingerprints_until_ns: int = 0,
) -> RecorderNode:
    """Start a file, recover what a killed recorder left, and return the node; see `Recorder` for the fingerprints."""
    black_box = build_black_box(config)
    missed = files.find_missed_intervals(black_box, start_ns)
    files.start_file((), start_ns)
    files.recover_orphans()
    for interval in missed:
        files.save_black_box(interval)
    rotation = FlushAndRotation(
        round(config.flush_period_s * 1e9),
        config.fsync,
        config.rotate_min * MINUTE_NS,
        config.rotate_mb * _MB,
        start_ns,
    )
    own = [keys.key(config.plant, keys.ALARM, name) for name in PRIORITIES]
    channels = ChannelBudget(config.most_keys, (*own, keys.key(config.plant, keys.HEALTH, NODE)))
    return RecorderNode(
        Recorder(config.plant, start_ns, fingerprints, fingerprints_until_ns),
        Policies(rotation, LatchedMessages(channels.max_latched_messages), black_box, channels),
        files,
        health_period_ns=round(config.health_period_s * 1e9),
        start_ns=start_ns,
        has_room=lambda: free_bytes(file_names(config).folder) >= config.resume_mb * _MB,
    )


def build_black_box(config: RecorderConfig) -> BlackBox:
    """Black box of the settings."""
    return BlackBox(round(config.black_box_min * MINUTE_NS), own=tuple(PRIORITIES))


def file_names(config: RecorderConfig) -> FileNames:
    """File names of the settings."""
    out = Path(config.out)
    return FileNames.of(out, config.plant, is_folder=out.is_dir())


if __name__ == "__main__":
    sys.exit(main("recorder", "recorder", RecorderConfig, run))
