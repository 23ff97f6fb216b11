"""Traffic of many plants for `scale`: the router, and the publisher of all plants."""

import json
import os
import struct
import threading
import time

import numpy as np
import zenoh

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode, encode, encoding_of
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.runtime.acl import NO_QUERYABLE
from reactorwatch.runtime.bus_zenoh import connect, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from recorder.tools.player import samples_of

SIGNALS = 3
LEARNED_ROWS = 900
MOST_ROWS = 20_000
WITHIN_S = 60.0
SHARING = 250  # plants that share a session
KNOWN_ROWS = 2  # of each plant, after which the router knows its keys; the time is taken from then on
OUT_EVERY = 50  # plants that are out in a row of the fleet, but at least one
FLEET = "reactor/*"


def plant_name(number: int) -> str:
    """Name of a plant; all names have the same length, so that a state can be renamed."""
    return f"p{number:05d}"


def record() -> list[Encoded]:
    """Messages of a plant."""
    return [
        encode(item)
        for item in samples_of(simulate_record(PlantConfig(seed=1), LEARNED_ROWS + MOST_ROWS), plant_name(0))
    ]


def alone_on_a_core(core: int) -> None:
    """Stay on one core, if there are others for the rest."""
    if (os.cpu_count() or 1) > 1:
        os.sched_setaffinity(0, {core})


def route(endpoint: str) -> None:
    """Be the router."""
    alone_on_a_core(1)
    hub = router(BusConfig(endpoint=endpoint))
    print("ready", flush=True)
    threading.Event().wait()
    del hub


def publish(endpoint: str, plants: int, rows: int, per_s: float) -> None:
    """Publish rows of plants, as fast as it goes or at a pace, some of them far out in that case."""
    alone_on_a_core(1)
    bus = connect(BusConfig(endpoint=endpoint), "publisher", StopSignal())
    assert bus is not None
    numbered, encoding = struct.Struct("<QQ"), encoding_of(Sample)
    signals = ("qc", "C", "T")
    # A session takes the longer to declare a key the more it has; a real plant has one of its own.
    buses = [connect(BusConfig(endpoint=endpoint), "publisher", StopSignal()) for _ in range(plants // SHARING + 1)]
    publishers = [
        [
            buses[number // SHARING]._session.declare_publisher(  # type: ignore[union-attr]
                keys.key(plant_name(number), keys.SAMPLE, signal),
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            for signal in signals
        ]
        for number in range(plants)
    ]
    arrived: dict[tuple[str, int], float] = {}

    def on_alarms(messages: list[Encoded]) -> None:
        now = time.perf_counter()
        for message in messages:
            alarm = decode(message.payload, message.encoding)
            if isinstance(alarm, Alarm) and alarm.alarm == "shewhart/T" and alarm.event == "raised":
                arrived[message.key.split("/")[1], alarm.time_ns] = now

    if per_s:
        bus.subscribe_batched(f"{FLEET}/{keys.ALARM}/**", on_alarms)
    payloads = [item.payload for item in record()[SIGNALS * LEARNED_ROWS :]]
    time.sleep(1.0)  # until the router knows all keys
    sent: dict[tuple[str, int], float] = {}
    begin, count = time.perf_counter(), 0
    for row in range(rows):
        if row == KNOWN_ROWS and per_s:
            for each in buses:  # what comes back from the router was behind all that came before it
                for _ in each._session.get(NO_QUERYABLE, timeout=WITHIN_S):  # type: ignore[union-attr]
                    pass
            time.sleep(1.0)  # until the monitor has heard it
            begin, count = time.perf_counter(), 0
        out = set(np.random.default_rng(row).choice(plants, max(plants // OUT_EVERY, 1), replace=False).tolist())
        for place in range(SIGNALS):
            payload, time_ns, far = payloads[SIGNALS * row + place], 0, b""
            if per_s and place == SIGNALS - 1 and row > KNOWN_ROWS and row % 3 == 1:
                sample = Sample.FromString(payload)
                sample.value += 100.0
                far, time_ns = sample.SerializeToString(), sample.time_ns
            for number in range(plants):
                if per_s and row >= KNOWN_ROWS and (wait_s := begin + count / per_s - time.perf_counter()) > 0:
                    time.sleep(wait_s)
                which = far if far and number in out else payload
                if which is far:
                    sent[plant_name(number), time_ns] = time.perf_counter()
                publishers[number][place].put(which, attachment=numbered.pack(number + 1, SIGNALS * row + place))
                count += 1
    deadline = time.perf_counter() + WITHIN_S
    while len(arrived) < len(sent) and time.perf_counter() < deadline:
        time.sleep(0.01)
    delays = [1e3 * (arrived[key] - since) for key, since in sent.items() if key in arrived]
    print(json.dumps({"out": len(sent), "delays_ms": delays}), flush=True)
    time.sleep(2.0 if not per_s else 0.0)  # what is on its way still goes
    os._exit(0)
