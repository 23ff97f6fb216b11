"""The watch over a fleet as a process: configuration, bus, core, loop."""

import secrets
import time

import structlog

from monitor_node import shards
from monitor_node.alarm_commands import COMMANDS
from monitor_node.config import MonitorConfig
from monitor_node.core import NODE
from monitor_node.fleet import FleetMonitor
from monitor_node.fleet_config import FleetConfig
from monitor_node.shards import Crew
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.model_file import model_on_the_bus
from reactorwatch.runtime.serve import StopSignal, serve, stop_on_signals

log = structlog.get_logger()

LINGER_S = 0.5
"""As for the monitor of one plant."""

PASSING = (keys.HEALTH, keys.ALARM_KPIS)
"""Told again and again of each plant; to remember them would take more than all else of a plant."""

MOST_TOKENS = 200
"""Plants for which a token is shown. Zenoh takes the longer for one the more there are: of 10,000, minutes."""

REPORT_EVERY_NS = 10_000_000_000


class FleetNode(FleetMonitor):
    """A fleet's monitor that shows on the bus which plants it watches, and logs what an operator wants to read.

    Args:
        config: how each plant is watched.
        fleet: which plants.
        bus: an open bus.
        start_ns: now.

    Raises:
        InputError: a file that the settings name cannot be used, or one that can hold but one plant's state.
    """

    def __init__(self, config: MonitorConfig, fleet: FleetConfig, bus: Bus, start_ns: int) -> None:
        for setting in ("alarm_state_file", "state_file"):
            if getattr(config, setting) is not None:
                raise InputError(f"{setting} holds what is known of one plant; leave it out for a fleet")
        self._bus = bus
        self._shown: set[str] = set()
        self._report_ns = start_ns
        self.expression = fleet.plants or f"{keys.ROOT}/{config.plant}"
        # The older of two with the same shard is in charge: names sort by the time of the start.
        name = f"{start_ns:020d}-{secrets.token_hex(4)}"
        self.crew = Crew(self.expression, shards.parsed(fleet.shard), name)
        model = model_on_the_bus(config.model)
        super().__init__(config, start_ns, self.crew, model=model, points=fleet.points, in_charge=self._show)

    def _show(self, plant: str, ours: bool) -> None:
        token = keys.key(plant, keys.ALIVE, NODE)
        log.info("watching" if ours else "no longer watching", plant=plant)
        if ours and len(self._shown) < MOST_TOKENS:
            self._shown.add(token)
            self._bus.announce(token)
        elif token in self._shown:
            self._shown.remove(token)
            self._bus.withdraw(token)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged."""
        return _logged(super().on_messages(messages, now_ns))

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms, what was refused and what is to be told of trainings are logged."""
        publications = _logged(super().on_tick(now_ns))
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + REPORT_EVERY_NS
            for plant, line in self.reports(now_ns):
                log.warning(line, plant=plant)
        return publications


def _logged(publications: list[Publication]) -> list[Publication]:
    for publication in publications:
        alarm = publication.message
        if isinstance(alarm, Alarm):
            topic = keys.parse(publication.key)
            plant = topic.plant if topic is not None else ""
            log.info("alarm", plant=plant, alarm=alarm.alarm, change=alarm.event, by=alarm.by, text=alarm.text)
    return publications


def run(config: MonitorConfig, fleet: FleetConfig, bus_config: BusConfig) -> None:
    """Watch the plants until SIGINT or SIGTERM.

    Raises:
        InputError: settings that do not fit together, or that the bus cannot use.
    """
    with stop_on_signals() as stop:
        bus = bus_zenoh.connect(bus_config, NODE, stop, passing=PASSING, crowded=True)
        if bus is None:
            return
        try:
            watch(FleetNode(config, fleet, bus, time.time_ns()), bus, stop)
        finally:
            bus.close()


def watch(node: FleetNode, bus: Bus, stop: StopSignal) -> None:
    """Watch the plants until asked to stop."""
    plants = node.expression
    log.info("listening", plants=plants)
    serve(
        node,
        bus,
        stop,
        subscriptions=(keys.samples_of(plants), f"{plants}/{keys.ALARM}/**"),
        on_messages=node.on_messages,
        tokens=(node.crew.tokens, f"{plants}/{keys.ALIVE}/*"),
        on_alive=node.on_alive,
        commands=tuple(f"{plants}/{keys.COMMAND}/{name}" for name in COMMANDS),
        on_ready=lambda: bus.announce(node.crew.token),
        linger_s=LINGER_S,
    )
