"""The recorder as a process: `python -m recorder [settings.toml]`."""

import sys
import time
from functools import partial
from pathlib import Path

from reactorwatch.contract import keys
from reactorwatch.errors import InputError, is_passing
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.http_pages import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import instance_name, join, wait_ready
from recorder.config import RecorderConfig
from recorder.core import COMMANDS, NODE
from recorder.node import RecorderNode
from recorder.recording_files import RecordingFiles, file_names, free_bytes


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
    # with a margin for the delay from publication, which dates a message on the bus, to receipt, which dates it here
    history_ns = round((bus_config.history_s + 10.0) * 1e9)

    def start() -> tuple[RecordingFiles, RecorderNode]:
        files, start_ns = RecordingFiles(config), time.time_ns()
        fingerprints = files.fingerprints_since(start_ns - history_ns)
        return files, RecorderNode(config, files, start_ns, fingerprints, start_ns + history_ns)

    try:  # errors in the settings are raised before waiting for a router
        RecordingFiles(config)
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


if __name__ == "__main__":
    sys.exit(main("recorder", "recorder", RecorderConfig, run))
