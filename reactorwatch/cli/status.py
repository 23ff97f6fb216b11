"""`status`: current state of plants, their nodes, rates and alarms, as JSON or as text for people."""

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from math import inf, isnan
from typing import TYPE_CHECKING, Any

from reactorwatch.cli.bus_client import connect_within
from reactorwatch.cli.display import Screen, json_line, print_lines, print_screen_text, screen
from reactorwatch.cli.status_view import ANNUNCIATED, SECOND_NS, Now, age_s, format_plant, sort_alarms
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import (
    Alarm,
    CommandReply,
    Health,
    Incident,
    ListAlarms,
    Promise,
    Sample,
    Suspect,
)
from reactorwatch.contract.suspects import set_suspects
from reactorwatch.errors import InputError
from reactorwatch.results.promise import state_promise
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect_now
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal, stop_on_signals
from reactorwatch.sentences.alarm import priority_word, state_word
from reactorwatch.terminal import printable

if TYPE_CHECKING:
    from reactorwatch.description.process import Process


WINDOW_S = 10
"""Seconds over which rates are counted, without the current one."""

REFRESH_S = 1.0  # as often as a rate can change
HISTORY_S = 60.0
"""History of health: longer than any node's period."""

ANSWER_WITHIN_S = 2.0  # a node answers within milliseconds; one that is busy is asked again


class StatusBoard:
    """State of the plants; may be called from any thread."""

    def __init__(self, start_ns: int, process: "Process | None" = None) -> None:
        self._start_ns = start_ns
        self._process = process
        self._newest: dict[str, dict[str, Sample]] = {}  # by plant and signal
        self._alive: set[tuple[str, str]] = set()
        self._health: dict[tuple[str, str], Health] = {}
        self._alarms: dict[tuple[str, str], Alarm] = {}
        self._suspects: dict[tuple[str, int], list[Suspect]] = {}  # by plant and incident
        self._promises: dict[str, Promise] = {}
        self._samples: dict[str, Counter[int]] = {}  # by plant and second
        self._lock = threading.Lock()

    def on_token(self, key: str, is_alive: bool) -> None:
        """Record that a node's token appeared or disappeared."""
        topic = keys.parse(key)
        if topic is not None:
            with self._lock:
                (self._alive.add if is_alive else self._alive.discard)((topic.plant, topic.name))

    def on_message(self, message: Encoded) -> None:
        """Record a publication."""
        topic = keys.parse(message.key)
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError:
            return
        if topic is None:
            return
        with self._lock:
            if isinstance(body, Health):
                self._health[topic.plant, topic.name] = body
            elif isinstance(body, Alarm):
                self._alarms[topic.plant, body.alarm] = body
                self._take_suspects(topic.plant, body.incident)
            elif isinstance(body, Incident):
                self._suspects[topic.plant, body.number] = list(body.suspects)
                self._take_suspects(topic.plant, body.number)
            elif isinstance(body, Promise):
                self._promises[topic.plant] = body
            elif isinstance(body, Sample):
                self._newest.setdefault(topic.plant, {})[topic.name] = body
                seconds = self._samples.setdefault(topic.plant, Counter())
                second = message.received_ns // SECOND_NS
                seconds[second] += 1
                for old in [item for item in seconds if item < second - WINDOW_S]:
                    del seconds[old]

    def _take_suspects(self, plant: str, number: int) -> None:
        """Give the alarms of an incident its newest suspects, but for those that name their cause themselves."""
        suspects = self._suspects.get((plant, number))
        for (name, _), alarm in self._alarms.items():
            if suspects is not None and name == plant and alarm.incident == number and not alarm.names_cause:
                set_suspects(alarm, suspects)

    def on_alarms(self, plant: str, alarms: list[Alarm]) -> None:
        """Record a node's list of alarms; published ones are newer and stay."""
        with self._lock:
            for alarm in alarms:
                self._alarms.setdefault((plant, alarm.alarm), alarm)

    @property
    def plants(self) -> list[str]:
        """Names of all plants with any record."""
        with self._lock:
            plants = {plant for plant, _ in (*self._alive, *self._health, *self._alarms)}
            return sorted(plants | self._samples.keys())

    def plant(self, name: str, now_ns: int) -> dict[str, Any]:
        """State of a plant as a JSON object."""
        with self._lock:
            second = now_ns // SECOND_NS
            span_s = min(WINDOW_S, second - self._start_ns // SECOND_NS - 1)  # without the second of the start
            counts = self._samples.get(name, Counter())
            samples = sum(count for item, count in counts.items() if second - span_s <= item < second)
            nodes = {node for plant, node in (*self._alive, *self._health) if plant == name}
            now = self._now(name, now_ns)
            promise, power = state_promise(self._promises.get(name))
            return {
                "plant": name,
                "samples_per_s": samples / span_s if span_s > 0 else None,
                "signals": self._signals(name),
                "nodes": [self._node(name, node, now_ns) for node in sorted(nodes)],
                "alarms": [_alarm(alarm, now) for alarm in self._visible_alarms(name)],
                "promise": promise,
                "power": power,
            }

    def text(self, now_ns: int, to: Screen = Screen()) -> str:  # noqa: B008 (it is frozen)
        """State of all plants for people; see `format_plant`."""
        parts = []
        for name in self.plants:
            plant = self.plant(name, now_ns)
            with self._lock:
                alarms, now = self._visible_alarms(name), self._now(name, now_ns)
            parts.append(format_plant(plant, alarms, now, to))
        return "\n\n".join(parts) or "no nodes"

    def _visible_alarms(self, plant: str) -> list[Alarm]:
        """Alarms of a plant that are in sight, the most urgent first."""
        alarms = (alarm for (name, _), alarm in self._alarms.items() if name == plant)
        return sort_alarms(alarm for alarm in alarms if alarm.state in ANNUNCIATED)

    def _now(self, plant: str, clock_ns: int) -> Now:
        """Present times of a plant; its own time is that of its newest sample or alarm."""
        times = [sample.time_ns for sample in self._newest.get(plant, {}).values()]
        times += [alarm.time_ns for (name, _), alarm in self._alarms.items() if name == plant]
        return Now(max(times, default=0), clock_ns)

    def _signals(self, plant: str) -> dict[str, dict[str, Any]]:
        """Newest value of each signal; null where none was received or measured."""
        from recorder.samples import measured_value  # imports NumPy, which `status --check` does without

        newest = self._newest.get(plant, {})
        described = {} if self._process is None else {signal.name: signal for signal in self._process.signals}
        signals: dict[str, dict[str, Any]] = {}
        for name in dict.fromkeys((*described, *sorted(newest))):
            sample, signal = newest.get(name), described.get(name)
            value = None if sample is None else measured_value(sample)
            unit = (sample.unit if sample is not None else "") or (signal.unit if signal is not None else "")
            signals[name] = {"value": None if value is None or isnan(value) else value, "unit": unit or None}
            if signal is not None:
                signals[name]["role"] = signal.role
        return signals

    def _node(self, plant: str, node: str, now_ns: int) -> dict[str, Any]:
        state: dict[str, Any] = {"node": node, "alive": (plant, node) in self._alive}
        health = self._health.get((plant, node))
        if health is not None:
            state |= {
                "phase": health.phase,
                "version": health.version,
                "said_s_ago": (now_ns - health.time_ns) / SECOND_NS,
                "uptime_s": health.uptime_s,
                **{name: getattr(health, name) for name in ("received", "published", "lost", "late", "refused")},
                "lag_ms": health.lag_ms,
            }
            if health.waiting_for:
                state["waiting_for"] = health.waiting_for
            if health.reference:
                state["reference"] = health.reference
            if health.phase == "training":
                state["training"] = health.training
        return state


def run(
    config: BusConfig,
    plant: str | None,
    listen_s: float,
    process: "Process | None" = None,
    *,
    once: bool,
    as_json: bool,
) -> None:
    """Show the status, once or until SIGINT or SIGTERM."""
    with stop_on_signals() as stop:
        try:
            bus = connect_now(config)
        except ConnectionError as error:
            raise InputError(f"no router at {config.endpoint}; `reactorwatch doctor` checks the connection") from error
        try:
            board = _subscribe(bus, plant or "*", process)
            if once or as_json:
                stop.wait(listen_s)
                _query_alarms(bus, board)
                print_screen_text(_text(board, as_json=as_json))
            else:
                _show(bus, board, stop)
        finally:
            bus.close()


def check_alive(config: BusConfig, plant: str, nodes: Sequence[str], timeout_s: float, *, as_json: bool) -> int:
    """Wait until nodes of a plant or shards of a fleet are alive, by their liveliness tokens, and print which are.

    Args:
        config: settings of the bus.
        plant: name of the plant.
        nodes: names of the nodes, or shards such as `2/5`, which are alive when a monitor of that shard of any fleet
            is; empty: all nodes that publish health, at least one.
        timeout_s: longest wait, in seconds.
        as_json: True to print one JSON object.

    Returns:
        0 if they are alive, else 1.

    Raises:
        InputError: a shard is malformed.
    """
    try:
        nodes = ["{}/{}".format(*keys.parse_shard(node)) if "/" in node else node for node in nodes]
    except ValueError as error:
        raise InputError(str(error)) from error
    alive: set[str] = set()  # tokens: two fleets may have monitors of a shard
    healthy: set[str] = set()
    changed = threading.Condition()
    until_s = time.monotonic() + timeout_s

    def are_alive() -> bool:
        wanted = set(nodes) or set(map(_node_name, healthy))
        return bool(wanted) and wanted <= set(map(_node_name, alive))

    def update(known: set[str], key: str, is_there: bool) -> None:
        with changed:
            (known.add if is_there else known.discard)(key)
            changed.notify_all()

    bus = connect_within(config, "status", timeout_s)
    if bus is not None:
        try:
            tokens = keys.all_keys(plant, keys.ALIVE)
            for expression in {keys.FLEET_TOKENS if "/" in node else tokens for node in nodes} or {tokens}:
                bus.subscribe_liveliness(expression, partial(update, alive))
            if not nodes:
                health = keys.all_keys(plant, keys.HEALTH)
                bus.subscribe(health, lambda message: update(healthy, message.key, True), history_s=HISTORY_S)
            with changed:
                changed.wait_for(are_alive, max(until_s - time.monotonic(), 0.0))
        finally:
            bus.close()
    with changed:
        names = set(map(_node_name, alive))
        found = {node: node in names for node in nodes or sorted(map(_node_name, healthy))}
    if as_json:
        states = [{"node": node, "alive": is_alive} for node, is_alive in found.items()]
        print_screen_text(json_line({"plant": plant, "nodes": states}))
    else:
        for node, is_alive in found.items():
            print_lines(f"{node} is {'alive' if is_alive else f'not there within {timeout_s:g} s'}")
        if not found:
            print_lines(f"no node of plant {plant!r} published its health within {timeout_s:g} s")
    return 0 if found and all(found.values()) else 1


def _node_name(key: str) -> str:
    """Name of a node, by the key of its token or its health; of a fleet's monitor its shard, such as `2/5`."""
    token, topic = keys.parse_fleet_token(key), keys.parse(key)
    if token is not None:
        return f"{token.number}/{token.of}"
    return key if topic is None else topic.name


def _subscribe(bus: ZenohBus, plant: str, process: "Process | None") -> StatusBoard:
    board = StatusBoard(time.time_ns(), process)
    bus.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), board.on_token)
    bus.subscribe(keys.all_keys(plant, keys.HEALTH), board.on_message, history_s=HISTORY_S)
    bus.subscribe(keys.all_keys(plant, keys.PROMISE), board.on_message, history_s=inf)
    for kind in (keys.SAMPLE, keys.ALARM, keys.INCIDENT):
        bus.subscribe(keys.all_keys(plant, kind), board.on_message)
    return board


def _query_alarms(bus: ZenohBus, board: StatusBoard) -> None:
    for plant in board.plants:
        for command in ("list_alarms", keys.LIST_RECORDER_ALARMS):
            question = Encoded(keys.key(plant, keys.COMMAND, command), *encode_message(ListAlarms()))
            for answer in bus.query(question, ANSWER_WITHIN_S):
                with contextlib.suppress(DecodeError):
                    reply = decode(answer.payload, answer.encoding)
                    if isinstance(reply, CommandReply):
                        board.on_alarms(plant, list(reply.alarms))


def _show(bus: ZenohBus, board: StatusBoard, stop: StopSignal) -> None:
    from rich.live import Live
    from rich.text import Text

    asked: list[str] = []
    with Live(auto_refresh=False) as live:
        while not stop.wait(REFRESH_S):
            if board.plants != asked:
                _query_alarms(bus, board)
                asked = board.plants
            live.update(Text.from_ansi(_text(board)), refresh=True)


def _text(board: StatusBoard, *, as_json: bool = False) -> str:
    now_ns = time.time_ns()
    if as_json:
        plants = [board.plant(name, now_ns) for name in board.plants]
        return printable(json_line({"plants": plants}))
    return board.text(now_ns, screen())


def _alarm(alarm: Alarm, now: Now) -> dict[str, Any]:
    return {
        "alarm": alarm.alarm,
        "state": state_word(alarm.state),
        "priority": priority_word(alarm.priority),
        "incident": alarm.incident or None,
        "age_s": age_s(alarm, now),
        "text": alarm.text,
        "suspect": [
            {"cause": item.cause, "probability": item.probability, "text": item.text} for item in alarm.suspects
        ],
    }
