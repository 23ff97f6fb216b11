"""The recorder as a process: `python -m recorder [settings.toml]`."""

import sys
import time
from collections.abc import Callable, Collection
from datetime import datetime
from pathlib import Path

import msgspec
import tomli_w

from reactorwatch.contract import keys
from reactorwatch.records.folder import make_folder
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from recorder.config import RecorderConfig
from recorder.core import NODE, Recorder
from recorder.files import RecordingFiles
from recorder.node import Decisions, RecorderNode
from recorder.policy.black_box import BlackBox
from recorder.policy.latched import Head
from recorder.policy.own_alarms import COMMANDS, PRIORITIES
from recorder.policy.retention import DAY_NS, Limits
from recorder.policy.room import Room
from recorder.policy.rotation import Filing
from recorder.policy.series import Series
from recorder.storage.ages import BootClock, read_boot_clock
from recorder.storage.part_file import PartFile

HISTORY_MARGIN_NS = 10_000_000_000
"""Between a message's publication, by which the bus knows how old it is, and its receipt, by which a file does."""

_MB = 1_000_000


def run(
    config: RecorderConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Record until SIGINT (Ctrl-C) or SIGTERM; the file is closed on every way out.

    Args:
        config: what is recorded, and where.
        bus_config: where the bus is.
        metrics_config: where its counts are shown.

    Raises:
        InputError: the folder cannot be made; the file exists already, or cannot be written; or the endpoint makes no
            sense.
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
        The last file; None if no router was there before the stop, or the disk was full at the end.

    Raises:
        InputError: as `run`.
    """
    # both before the waiting for a router
    series = series_for(config)
    if (
        series.dated and not series.folder.suffix[1:].isalpha()
    ):  # run.csv is a file of another kind, not a folder's name
        make_folder(series.folder, "--out")
    files = files_for(config)
    with serve_metrics(metrics_config, Metrics(config.plant, NODE, files.free_bytes), NODE) as metrics:
        bus = bus_zenoh.connect(bus_config, NODE, stop)
        if bus is None:
            return None
        try:
            start_ns = time.time_ns()
            with files:
                history_ns = round(bus_config.history_s * 1e9) + HISTORY_MARGIN_NS
                known = files.received_since(start_ns - history_ns)
                node = begin(config, files, start_ns, known, known_until_ns=start_ns + history_ns)
                on_publish = metrics.observe(node.alarms) if metrics is not None else None
                loop = EventLoop(node, bus, stop, drain_timeout_s=config.linger_s, on_publish=on_publish)
                loop.subscribe(config.key_expression, history_s=bus_config.history_s, on_gap=node.on_gap)
                loop.accept_commands(*(keys.key(config.plant, keys.COMMAND, name) for name in COMMANDS))
                bus.declare_token(keys.key(config.plant, keys.ALIVE, NODE))
                loop.run()
                return files.path
        finally:
            bus.close()


def files_for(
    config: RecorderConfig,
    open_part: Callable[[Path], PartFile] = PartFile,
    read_clock: Callable[[], BootClock] = read_boot_clock,
) -> RecordingFiles:
    """The files that the settings ask for.

    Args:
        config: the settings.
        open_part: see `RecordingFiles`.
        read_clock: see `RecordingFiles`.

    Raises:
        InputError: as `run`.
    """
    about = {
        "plant": config.plant,
        "key_expression": config.key_expression,
        "configuration": tomli_w.dumps(msgspec.to_builtins(config)),
        **config.about,
    }
    limits = Limits(config.keep_mb * _MB, config.keep_days * DAY_NS, config.keep_files)
    synced = config.fsync != "never"
    return RecordingFiles(series_for(config), about, limits, synced=synced, open_part=open_part, read_clock=read_clock)


def begin(
    config: RecorderConfig,
    files: RecordingFiles,
    start_ns: int,
    known: Collection[int] = (),
    known_until_ns: int = 0,
) -> RecorderNode:
    """Begin a file, and have done what a killed recorder left undone.

    Returns:
        The node that goes on from there; see `Recorder` for what is known.
    """
    black_box = black_box_for(config)
    missed = files.missed_stretches(black_box, start_ns)
    files.begin((), start_ns)
    files.recover_left_behind()
    for stretch in missed:
        files.keep_for_good(stretch)
    return node_for(config, files, start_ns, black_box, known, known_until_ns)


def black_box_for(config: RecorderConfig) -> BlackBox:
    """The black box that the settings ask for."""
    return BlackBox(round(config.black_box_min * MINUTE_NS), own=tuple(PRIORITIES))


def node_for(
    config: RecorderConfig,
    files: RecordingFiles,
    start_ns: int,
    black_box: BlackBox,
    known: Collection[int] = (),
    known_until_ns: int = 0,
) -> RecorderNode:
    """The node that writes to them; see `Recorder` for what is known."""
    filing = Filing(
        round(config.flush_period_s * 1e9),
        config.fsync,
        config.rotate_min * MINUTE_NS,
        config.rotate_mb * _MB,
        start_ns,
    )
    own = [keys.key(config.plant, keys.ALARM, name) for name in PRIORITIES]
    room = Room(config.most_keys, (*own, keys.key(config.plant, keys.HEALTH, NODE)))
    return RecorderNode(
        Recorder(config.plant, start_ns, known, known_until_ns),
        Decisions(filing, Head(room.most_repeated), black_box, room),
        files,
        health_period_ns=round(config.health_period_s * 1e9),
        start_ns=start_ns,
        has_room=lambda: files.free_bytes() >= config.resume_mb * _MB,
    )


def series_for(config: RecorderConfig) -> Series:
    """The names that the settings give to files."""
    out = Path(config.out)
    return Series.of(out, config.plant, is_folder=out.is_dir())


def file_for(config: RecorderConfig, now: datetime) -> Path:
    """The first of them."""
    return series_for(config).first(now)


if __name__ == "__main__":
    sys.exit(main("recorder", "recorder", RecorderConfig, run))
