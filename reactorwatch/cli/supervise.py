"""`up`: the router in this process, the nodes as processes, until somebody says stop."""

import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import structlog

from monitor_node.config import MonitorConfig
from plant_node.config import PlantConfig
from reactorwatch.cli.processes import Processes, settings_text, write_settings
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.logs import configure
from reactorwatch.runtime.serve import stop_on_signals
from recorder.__main__ import file_for
from recorder.config import RecorderConfig

log = structlog.get_logger()

LOOK_EVERY_S = 0.5


def run_until_stopped(config: Path | None, endpoint: str | None, out: Path, flags: dict[str, Any]) -> int:
    """Run everything until SIGINT or SIGTERM, or until a node ends by itself.

    Args:
        config: settings file, or None.
        endpoint: the router's address, or None.
        out: folder for the recording and the settings that ran; made if it is not there.
        flags: of the plant; None: not said.

    Returns:
        0 if it was stopped or the plant came to its end, 1 if a node failed.

    Raises:
        InputError: settings that cannot be used.
    """
    configure()
    tables = read_settings(config)
    bus_config = section(BusConfig, "bus", tables, {"endpoint": endpoint})
    name = flags.get("name")
    waiting = {"wait_for": ["monitor", "recorder"]}
    plant = section(PlantConfig, "plant", {"plant": {**waiting, **tables.get("plant", {})}}, flags)
    monitor = section(MonitorConfig, "monitor", tables, {"plant": name or plant.name})
    recorder = section(RecorderConfig, "recorder", tables, {"plant": name or plant.name})
    bus = router(bus_config)  # before anything is written: an address that is taken leaves nothing behind
    try:
        settings = _write_down(out, recorder, plant.seed, {"bus": bus_config, "plant": plant, "monitor": monitor})
        with stop_on_signals() as stop, Processes(settings) as processes:
            woken = threading.Event()
            stop.wakes(woken.set)
            for node in ("recorder", "monitor", "plant"):
                processes.start(node)
            log.info("running", plant=plant.name, router=bus_config.endpoint, folder=str(out), stop="Ctrl-C")
            while not woken.wait(LOOK_EVERY_S):
                ended = processes.ended()
                if ended:
                    for node, code in ended.items():
                        log.info("ended by itself", node=node, code=code)
                    return 1 if any(ended.values()) else 0
            return 0
    finally:
        bus.close()


def _write_down(out: Path, recorder: RecorderConfig, seed: int, others: dict[str, msgspec.Struct]) -> Path:
    """Write the whole settings where the recordings will be, named after the moment as they are; returns their file."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: the folder cannot be made: {error.strerror}") from error
    recorder = msgspec.structs.replace(recorder, out=str(out))
    settings = file_for(recorder, datetime.now(UTC)).with_suffix(".toml")
    about = {"seed": str(seed), "settings": settings_text(others), **recorder.about}
    recorder = msgspec.structs.replace(recorder, about=about)
    write_settings(settings, {**others, "recorder": recorder})
    return settings
