"""Replay a recording or a record on the bus; as a process: `python -m recorder.tools.replay [settings.toml]`.

The keys of its terminal control it, those of `ros2 bag play`: space pauses and resumes, the right arrow publishes the
next row of a paused replay, up and down double and halve the rate. A line shows its position.
"""

import os
import re
import select
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from math import inf, isinf
from pathlib import Path

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.description.read import ProcessChoice, read_signals
from reactorwatch.errors import InputError
from reactorwatch.records.decode import check_workbook, is_table
from reactorwatch.records.record import NEVER_NS, to_time_ns
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import instance_name, join, wait_alive
from recorder.config import ReplayConfig
from recorder.files.recording import Recording
from recorder.tools.convert import plant_name
from recorder.tools.inspect import zero_ns_of
from recorder.tools.player import EVERYTHING, SAMPLES, Player, filter_playable, filter_time, samples_of

log = structlog.get_logger()

NODE = "replay"
HELP = "space: pause, right: next row, up and down: rate"

_KEYS = re.compile(rb" |\x1b[\[O]([ABC])")
_SPACE, _UP, _DOWN = b"", b"A", b"B"
_TO_LINE_START, _CLEAR_REST = "\r", "\x1b[K"


@contextmanager
def control_by_keys(player: Player, loop: EventLoop) -> Iterator[None]:
    """Read keys and show the position while the context lasts."""
    if not _is_in_foreground():
        yield
        return
    import termios  # not everywhere: systems without it have no such terminal either
    import tty

    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    source, sink = os.pipe()
    reader = threading.Thread(target=_read_keys, args=(player, loop, keyboard, source), name="keys", daemon=True)
    tty.setcbreak(keyboard)
    reader.start()
    try:
        yield
    finally:
        os.close(sink)
        reader.join()
        os.close(source)
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)
        _show("")


def _is_in_foreground() -> bool:
    """True if the terminal's keys are for this process: one in the background would be stopped by reading them."""
    if sys.stdin is None or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:  # the terminal is another session's
        return False


def _read_keys(player: Player, loop: EventLoop, keyboard: int, end: int) -> None:
    """Hand keys to the loop, and refresh the line, until `end` is closed or the terminal is."""
    while True:
        ready, _, _ = select.select([keyboard, end], [], [], 0.25)
        if end in ready:
            return
        if keyboard in ready:
            try:
                typed = os.read(keyboard, 64)
            except OSError:
                return
            if not typed:
                return
            for key in _KEYS.finditer(typed):
                loop.call(partial(_act, player, key[1] or _SPACE))
        loop.call(partial(_show_position, player))


def _act(player: Player, key: bytes, now_ns: int) -> list[Publication]:
    if key == _SPACE:
        player.set_pace(now_ns, paused=not player.paused)
    elif key in (_UP, _DOWN):
        player.set_pace(now_ns, rate=min(max(player.rate * (2.0 if key == _UP else 0.5), 1e-3), 1e6))
    else:
        return player.step(now_ns)
    return []


def _show_position(player: Player, now_ns: int) -> list[Publication]:
    minutes = player.position_min(now_ns)
    if minutes is not None:
        _show(f"{minutes:.1f} min, {player.status} ({HELP})")
    return []


def _show(text: str) -> None:
    """Write the line, and leave the cursor at its start, so that a line of the log replaces it."""
    width = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    sys.stderr.write(f"{_TO_LINE_START}{text[: width - 1]}{_CLEAR_REST}{_TO_LINE_START}")
    sys.stderr.flush()


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
    player = Player(tape, config.rate, loop=config.loop, on_wait=_log_wait)
    if player.finished:
        begin = "the start" if isinf(config.from_min) else f"{config.from_min:g} min"
        end = "the end" if isinf(config.to_min) else f"{config.to_min:g} min"
        raise InputError(f"{config.file}: holds nothing to play from {begin} to {end}")
    name = instance_name()
    tokens = [keys.instance_token(plant, NODE, name) for plant in plants]
    with join(bus_config, NODE, stop, *tokens) as bus:
        if bus is None:
            return 0
        for plant in plants:
            wait_alive(bus, plant, config.wait_for, stop, NODE)
        log.info("replaying", file=config.file, plant=", ".join(plants), rate=config.rate)
        for plant in plants:
            bus.declare_token(keys.key(plant, keys.ALIVE, NODE))
        loop = EventLoop(player, bus, stop)
        with control_by_keys(player, loop):
            loop.run()
    log.info("replayed", file=config.file, messages=player.published, to_the_end=player.finished)
    return player.published


def open_tape(config: ReplayConfig) -> tuple[tuple[str, ...], Callable[[], Iterator[Publication]]]:
    """Names of the plants on the bus, and the function that returns the publications.

    Raises:
        InputError: as `run_replay`.
    """
    path, choice = Path(config.file), ProcessChoice(config.process, config.inputs, config.outputs)
    check_workbook(path, config.table.sheet)
    if is_table(path):
        plant = plant_name(config.plant, choice.load())
        record = read_signals(path, choice, config.columns, config.table)
        _check_signals(path, record.columns)
        if record.read_as:
            log.info("read as", file=config.file, form=record.read_as)
        if record.runs is not None:
            log.warning("plays several runs one after the other", file=config.file, runs=record.describe_runs())
        zero_ns = record.stored_zero_ns
        return (plant,), lambda: filter_time(samples_of(record, plant, zero_ns), *_span_ns(config, zero_ns))
    if config.table.resample is not None:
        raise InputError(f"--resample: the recording {path} is replayed as it was received; export it with --resample")
    signals = None if choice.is_default else {signal.name for signal in choice.load().signals}
    recording = Recording(path)
    topics = [topic for topic in recording.sample_topics if signals is None or topic.name in signals]
    plants = tuple(sorted({topic.plant for topic in topics}))
    if not plants:
        raise recording.no_samples_error()
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
    from_ns, to_ns = _span_ns(config, 0 if whole else zero_ns_of(recording))

    def tape() -> Iterator[Publication]:  # lists the files at each pass: a recorder adds and deletes some
        played = filter_playable(Recording(path).messages(kinds), config.plant, kinds, signals)
        return filter_time(played, from_ns, to_ns)

    return (config.plant,) if config.plant else plants, tape


def _log_wait(wait_s: float) -> None:
    """Say that nothing is published for long, because the recorded clock jumps."""
    log.warning("waiting: the recorded clock jumps", seconds=round(wait_s), cure="a higher --rate, or --from behind it")


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
