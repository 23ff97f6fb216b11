"""Control of a replay by the keys of its terminal, and a line that shows its position; nothing without a terminal.

Space pauses and resumes, the right arrow publishes the next row of a paused replay, up and down double and halve the
rate: the keys of `ros2 bag play`.
"""

import os
import re
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.runtime.event_loop import EventLoop
from recorder.tools.player import Player

REFRESH_S = 0.25
RATES = (1e-3, 1e6)
"""Slowest and fastest rate that keys set."""

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
        ready, _, _ = select.select([keyboard, end], [], [], REFRESH_S)
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
        (player.resume if player.paused else player.pause)(now_ns)
    elif key in (_UP, _DOWN):
        slowest, fastest = RATES
        player.set_rate(min(max(player.rate * (2.0 if key == _UP else 0.5), slowest), fastest), now_ns)
    else:
        try:
            return player.step(1, now_ns)
        except InputError:  # it is playing: there the next row comes by itself
            return []
    return []


def _show_position(player: Player, now_ns: int) -> list[Publication]:
    minutes = player.position_min(now_ns)
    if minutes == minutes:  # not before the start, nor at the end
        _show(f"{minutes:.1f} min, {player.status} ({HELP})")
    return []


def _show(text: str) -> None:
    """Write the line, and leave the cursor at its start, so that a line of the log replaces it."""
    width = os.get_terminal_size(sys.stderr.fileno()).columns or 80
    sys.stderr.write(f"{_TO_LINE_START}{text[: width - 1]}{_CLEAR_REST}{_TO_LINE_START}")
    sys.stderr.flush()
