"""Replay: a recording or a record onto the bus, as the plant published it."""

from collections.abc import Iterator
from pathlib import Path

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.records.csv_file import read_csv
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.liveliness import wait_alive
from reactorwatch.runtime.serve import StopSignal, serve, stop_on_signals
from recorder.config import ReplayConfig
from recorder.mcap_file import plants_in, read_messages
from recorder.player import EVERYTHING, SAMPLES, Player, playable, samples_of

__all__ = ["Player", "ReplayConfig", "replay", "run_replay", "samples_of"]

log = structlog.get_logger()

NODE = "replay"
PLANT = "cstr"
"""The name of a plant whose record has none."""


def run_replay(config: ReplayConfig, bus_config: BusConfig) -> None:
    """Play a file until its end, SIGINT (Ctrl-C) or SIGTERM.

    Raises:
        InputError: the file cannot be read or holds no samples, or those of several plants and a single name was given.
    """
    with stop_on_signals() as stop:
        replay(config, bus_config, stop)


def replay(config: ReplayConfig, bus_config: BusConfig, stop: StopSignal) -> int:
    """Play a file until its end or until `stop` is set.

    Returns:
        How many messages went out.

    Raises:
        InputError: as `run_replay`.
    """
    plants, publications = _opened(config)
    player = Player(publications, config.rate)
    bus = bus_zenoh.connect(bus_config, NODE, stop)
    if bus is None:
        return 0
    try:
        for plant in plants:
            wait_alive(bus, plant, config.wait_for, stop, NODE)
        log.info("replaying", file=config.file, plant=", ".join(plants), rate=config.rate)
        for plant in plants:
            bus.announce(keys.key(plant, keys.ALIVE, NODE))
        serve(player, bus, stop)
    finally:
        bus.close()
    log.info("replayed", file=config.file, messages=player.published, to_the_end=player.finished)
    return player.published


def _opened(config: ReplayConfig) -> tuple[tuple[str, ...], Iterator[Publication]]:
    """The names of the plants as they will be on the bus, and what will be published."""
    path = Path(config.file)
    if path.suffix.lower() == ".csv":
        plant = config.plant or PLANT
        return (plant,), samples_of(read_csv(path, config.columns), plant)
    plants = plants_in(path)
    if not plants:
        raise InputError(f"{path}: holds no samples")
    if config.plant and len(plants) > 1:
        raise InputError(f"{path}: holds samples of {', '.join(plants)}; they cannot all be played as {config.plant!r}")
    kinds = EVERYTHING if config.everything else SAMPLES
    return (config.plant,) if config.plant else plants, playable(read_messages(path, kinds), config.plant, kinds)
