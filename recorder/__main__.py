"""The recorder as a process: `python -m recorder [settings.toml]`."""

import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import structlog

from reactorwatch.contract import keys
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.entry import main
from reactorwatch.runtime.serve import StopSignal, serve, stop_on_signals
from recorder.config import RecorderConfig
from recorder.core import NODE, Recorder
from recorder.mcap_writer import RecordingWriter, check_free
from recorder.node import RecorderNode

log = structlog.get_logger()


def run(config: RecorderConfig, bus_config: BusConfig) -> None:
    """Record until SIGINT (Ctrl-C) or SIGTERM; the file is closed on every way out.

    Raises:
        InputError: the file exists already, or cannot be written; or the endpoint makes no sense.
    """
    with stop_on_signals() as stop:
        record(config, bus_config, stop)


def record(config: RecorderConfig, bus_config: BusConfig, stop: StopSignal) -> Path | None:
    """Record until `stop` is set.

    Returns:
        The file; None if no router was there before the stop.

    Raises:
        InputError: as `run`.
    """
    path = file_for(config, datetime.now(UTC))
    check_free(path)  # before the waiting for a router
    bus = bus_zenoh.connect(bus_config, NODE, stop)
    if bus is None:
        return None
    try:
        start_ns = time.time_ns()
        with RecordingWriter(path, {"plant": config.plant, "key_expression": config.key_expression}) as writer:
            node = RecorderNode(
                Recorder(config.plant, start_ns),
                writer,
                health_period_ns=round(config.health_period_s * 1e9),
                flush_period_ns=round(config.flush_period_s * 1e9),
                start_ns=start_ns,
            )
            log.info("recording", file=str(path), what=config.key_expression)
            serve(
                node,
                bus,
                stop,
                subscriptions=(config.key_expression,),
                on_ready=lambda: bus.announce(keys.key(config.plant, keys.ALIVE, NODE)),
                linger_s=config.linger_s,
            )
    finally:
        bus.close()
    log.info("recorded", file=str(path))
    return path


def file_for(config: RecorderConfig, now: datetime) -> Path:
    """The file that the settings name, or the one in the folder that they name."""
    out = Path(config.out)
    if out.suffix == ".mcap" and not out.is_dir():
        return out
    return out / f"{config.plant}-{now.astimezone(UTC):%Y%m%dT%H%M%SZ}.mcap"


if __name__ == "__main__":
    sys.exit(main("recorder", "recorder", RecorderConfig, run))
