"""Replay a recording or a record on the bus; as a process: `python -m recorder.tools.replay [settings.toml]`."""

import sys
from collections.abc import Callable, Iterable, Iterator
from math import inf, isinf
from pathlib import Path

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.read import read_signals
from reactorwatch.errors import InputError
from reactorwatch.records.record import NEVER_NS, to_time_ns
from reactorwatch.records.source_text import is_table
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.liveliness import wait_alive
from reactorwatch.runtime.node_main import main
from recorder.config import ReplayConfig
from recorder.tools.convert import plant_name
from recorder.tools.inspect import zero_ns_of
from recorder.tools.mcap_file import read_messages, sample_topics_in
from recorder.tools.player import (
    COMMANDS,
    EVERYTHING,
    SAMPLES,
    Player,
    filter_playable,
    filter_time,
    samples_of,
)
from recorder.tools.replay_keys import control_by_keys

__all__ = ["Player", "ReplayConfig", "replay", "run_replay", "samples_of"]

log = structlog.get_logger()

NODE = "replay"


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
        Number of published messages.

    Raises:
        InputError: as `run_replay`.
    """
    plants, tape = open_tape(config)
    player = Player(tape, config.rate, loop=config.loop)
    if player.finished:
        begin = "the start" if isinf(config.from_min) else f"{config.from_min:g} min"
        end = "the end" if isinf(config.to_min) else f"{config.to_min:g} min"
        raise InputError(f"{config.file}: holds nothing to play from {begin} to {end}")
    bus = bus_zenoh.connect(bus_config, NODE, stop)
    if bus is None:
        return 0
    try:
        for plant in plants:
            wait_alive(bus, plant, config.wait_for, stop, NODE)
        log.info("replaying", file=config.file, plant=", ".join(plants), rate=config.rate)
        for plant in plants:
            bus.declare_token(keys.key(plant, keys.ALIVE, NODE))
        loop = EventLoop(player, bus, stop)
        loop.accept_commands(*(keys.key(plant, keys.COMMAND, name) for plant in plants for name in COMMANDS))
        with control_by_keys(player, loop):
            loop.run()
    finally:
        bus.close()
    log.info("replayed", file=config.file, messages=player.published, to_the_end=player.finished)
    return player.published


def open_tape(config: ReplayConfig) -> tuple[tuple[str, ...], Callable[[], Iterator[Publication]]]:
    """Names of the plants on the bus, and the function that returns the publications.

    Raises:
        InputError: as `run_replay`.
    """
    path, choice = Path(config.file), ProcessChoice(config.process, config.inputs, config.outputs)
    if is_table(path):
        plant, record = (
            plant_name(config.plant, choice.load()),
            read_signals(path, choice, config.columns, config.table),
        )
        _check_signals(path, record.columns)
        if record.read_as:
            log.info("read as", file=config.file, form=record.read_as)
        if record.runs is not None:
            log.warning("plays several runs one after the other", file=config.file, runs=record.describe_runs())
        zero_ns = record.stored_zero_ns
        return (plant,), lambda: filter_time(samples_of(record, plant, zero_ns), *_span_ns(config, zero_ns))
    signals = None if choice.is_default else {signal.name for signal in choice.load().signals}
    topics = [topic for topic in sample_topics_in(path) if signals is None or topic.name in signals]
    plants = tuple(sorted({topic.plant for topic in topics}))
    if not plants:
        raise InputError(f"{path}: holds no samples")
    if not config.plant:
        for plant in plants:
            try:
                keys.check_plant(plant)
            except ValueError as error:
                raise InputError(f"{path}: {error}; choose the name by --plant") from error
    _check_signals(path, sorted({topic.name for topic in topics}))
    if config.plant and len(plants) > 1:
        raise InputError(f"{path}: holds samples of {', '.join(plants)}; they cannot all be played as {config.plant!r}")
    kinds = EVERYTHING if config.everything else SAMPLES
    whole = (config.from_min, config.to_min) == (-inf, inf)
    from_ns, to_ns = _span_ns(config, 0 if whole else zero_ns_of(path))

    def tape() -> Iterator[Publication]:
        played = filter_playable(read_messages(path, kinds), config.plant, kinds, signals)
        return filter_time(played, from_ns, to_ns)

    return (config.plant,) if config.plant else plants, tape


def _check_signals(path: Path, names: Iterable[str]) -> None:
    """Check that signals can be published.

    Raises:
        InputError: the name of one cannot be part of a key.
    """
    for name in names:
        try:
            keys.check_signal(name)
        except ValueError as error:
            cure = f"import it with a process that gives the signal another name and has column = {name!r}"
            raise InputError(f"{path}: {error}; {cure}") from error


def _span_ns(config: ReplayConfig, zero_ns: int) -> tuple[int, int]:
    """Start and end of the replay in sample time."""
    begin, end = config.from_min, config.to_min
    return (
        -NEVER_NS if isinf(begin) else to_time_ns(begin, zero_ns),
        NEVER_NS if isinf(end) else to_time_ns(end, zero_ns),
    )


if __name__ == "__main__":
    sys.exit(
        main("recorder.tools.replay", "replay", ReplayConfig, lambda config, bus, _metrics: run_replay(config, bus))
    )
