"""Capacity of one monitor of a fleet: live, through a real router, with 1 to 10,000 plants.

A table with, for each number of plants:

- samples a second that one core processes, with the filter of the reactor's equations for each plant and all
  univariate charts and MEWMA, from their arrival to publication; beside it a bare Zenoh subscriber in Python that only
  counts the same messages, in the same run, and the ratio. A publisher sends as fast as it can. Seconds are those of
  the processor's time, of all threads of the process, so that others on the machine do not count;
- the same without the bus: from bytes to results;
- memory a plant: how much more the process takes with all plants than with a tenth of them.

The plants resume from the state of one that was trained, with names of their own. `latency.py` has the time from a
sample to its alarm.

Goal: at least 60,000 samples/s without the bus, so that 10,000 plants at 1 Hz take one core or two shards; at most
130 kB a plant; live at least 45, 50 and 40 % of the bare subscriber with 1, 100 and 1,000 plants.
"""

import gc
import json
import logging
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from monitor_node.__main__ import UNCACHED, watch
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import FleetConfig
from monitor_node.monitor_state import open_seal, seal
from monitor_node.node import MonitorNode
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encoding_of
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.runtime.bus_zenoh import connect, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import configure_log
from recorder.tools.player import samples_of

SIGNALS = 3
LEARNED_ROWS = 900
MOST_ROWS = 20_000
SHARING = 250  # plants that share a session
KNOWN_ROWS = 2  # of each plant, after which the router knows its keys; the time is taken from then on
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


def publish(endpoint: str, plants: int, rows: int) -> None:
    """Publish rows of plants as fast as it goes."""
    alone_on_a_core(1)
    numbered, encoding = struct.Struct("<QQ"), encoding_of(Sample)
    # A session takes the longer to declare a key the more it has; a real plant has one of its own.
    buses = [connect(BusConfig(endpoint=endpoint), "publisher", StopSignal()) for _ in range(plants // SHARING + 1)]
    publishers = [
        [
            buses[number // SHARING]._session.declare_publisher(  # type: ignore[union-attr]
                keys.key(plant_name(number), keys.SAMPLE, signal),
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            for signal in ("qc", "C", "T")
        ]
        for number in range(plants)
    ]
    payloads = [item.payload for item in record()[SIGNALS * LEARNED_ROWS :]]
    time.sleep(1.0)  # until the router knows all keys
    for place in range(SIGNALS * rows):
        for number in range(plants):
            publishers[number][place % SIGNALS].put(payloads[place], attachment=numbered.pack(number + 1, place))
    time.sleep(2.0)  # what is on its way still goes
    os._exit(0)


SIZES = (1, 10, 100, 1000, 10_000)
FAST_SAMPLES = 600_000
IDLE_S = 10.0
PATIENT = 1e6  # periods: between training and the first sample live a plant is no silent one
FAST = MonitorConfig(
    training_min=20.0,
    charts=("shewhart", "ewma", "cusum", "mewma"),
    silence_periods=PATIENT,
    diagnose_training=False,  # the work of another process
)


def fast_rows(count: int) -> int:
    """Rows of every plant that are published as fast as possible."""
    return min(max(FAST_SAMPLES // (SIGNALS * count), 10), MOST_ROWS)


# --- processes that are measured ---------------------------------------------------------------------------------


def memory_bytes() -> int:
    """Memory of this process in bytes."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Counting(MonitorNode):
    """A fleet's monitor that counts its samples and stops after the last."""

    def __init__(self, config: MonitorConfig, stop: StopSignal) -> None:
        super().__init__(config, time.time_ns(), FleetConfig(plants=FLEET))
        self._stop, self.samples, self.expected = stop, 0, -1
        self.began_s = self.ended_s = 0.0
        self.known = self.before = 0

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `MonitorNode`."""
        if self.samples < self.known:
            self.began_s, self.before = time.process_time(), self.samples
        publications = super().on_messages(messages, now_ns)
        self.samples += len(messages)
        self.ended_s = time.process_time()
        if self.samples == self.expected:
            self._stop.set()
        return publications

    def learn(self, plants: int) -> int:
        """Train one plant, and let the others resume from its state; returns the memory of one of them, in bytes."""
        messages = record()[: SIGNALS * LEARNED_ROWS]
        start_ns = time.time_ns() - LEARNED_ROWS * 3 * 10**9
        for row in range(LEARNED_ROWS):  # as if they had come one by one, a sample a second
            for index in range(SIGNALS * row, SIGNALS * (row + 1)):
                super().on_messages(messages[index : index + 1], start_ns + index * 10**9)
        trained = self.monitor(plant_name(0))
        assert trained.pipeline.evaluation.is_ordinary
        body, few = open_seal(trained.to_bytes()), max(plants // 10, 1)
        for number in range(1, plants):
            if number == few:
                before = memory_bytes()
            name = plant_name(number)
            state = seal(body.replace(plant_name(0).encode(), name.encode()))
            self.register(name, time.time_ns(), verified=True, restore=partial(_restore, state))
        self.on_history_end()
        return (memory_bytes() - before) // (plants - few) if plants > few else 0


def _restore(state: bytes, monitor: Monitor) -> None:
    monitor.from_bytes(state)


def monitor(endpoint: str, plants: int, expected: int) -> None:
    """Watch the fleet until so many samples have come, or no more come."""
    alone_on_a_core(0)
    stop = StopSignal()
    bus = connect(BusConfig(endpoint=endpoint), "monitor", stop, uncached=UNCACHED, many_keys=True)
    assert bus is not None
    node = Counting(FAST, stop)
    taken = node.learn(plants)  # first: memory that another fleet has freed would be used again, and not be counted
    core = without_bus(plants)
    node.samples, node.expected, node.known = 0, expected, KNOWN_ROWS * SIGNALS * plants
    serving = threading.Thread(target=watch, args=(node, bus, stop))
    serving.start()
    print("ready", flush=True)
    last = -1
    while serving.is_alive() and not 0 < node.samples == last:  # or what is missing does not come any more
        last = node.samples
        serving.join(IDLE_S)
    _check_known(node.samples, node.known)
    result = {"samples": node.samples - node.before, "cpu_s": node.ended_s - node.began_s}
    print(json.dumps(result | {"bytes": taken, "core": core}), flush=True)
    os._exit(0)  # thousands of tokens need not be withdrawn one by one


def without_bus(plants: int) -> float:
    """Samples a second from bytes to results."""
    node = Counting(FAST, StopSignal())
    node.learn(plants)
    messages = record()[SIGNALS * LEARNED_ROWS :]
    fleet = [
        item._replace(key=item.key.replace(plant_name(0), plant_name(number)), received_ns=1)
        for row in range(max(60_000 // (SIGNALS * plants), 3) if plants > 100 else 200)
        for number in range(plants)
        for item in messages[SIGNALS * row : SIGNALS * (row + 1)]
    ]
    now_ns = time.time_ns()
    node.on_messages(fleet[: SIGNALS * plants], now_ns)  # compiles
    begin = time.process_time()
    for index in range(SIGNALS * plants, len(fleet), 2000):
        node.on_messages(fleet[index : index + 2000], now_ns + index)
    return (len(fleet) - SIGNALS * plants) / (time.process_time() - begin)


def _check_known(arrived: int, known: int) -> None:
    """End this process, whose threads still serve, if not even the first rows, which are not timed, all came."""
    if arrived <= known:
        print(f"{arrived} messages arrived, and the router lost some of the first {known}", file=sys.stderr, flush=True)
        os._exit(1)


def bare(endpoint: str, plants: int, expected: int) -> None:
    """Count what comes."""
    alone_on_a_core(0)
    bus = connect(BusConfig(endpoint=endpoint), "bare", StopSignal())
    assert bus is not None
    known = KNOWN_ROWS * SIGNALS * plants
    session, done, times = bus._session, threading.Event(), [0.0, 0.0, 0.0]

    def count(_sample: zenoh.Sample) -> None:
        times[0] += 1
        if times[0] == known:
            times[1] = time.process_time()
        if times[0] == expected:
            times[2] = time.process_time()
            done.set()

    subscriber = session.declare_subscriber(keys.samples_of(FLEET), count)
    print("ready", flush=True)
    last = -1.0
    while not done.wait(IDLE_S) and not 0 < times[0] == last:
        last = times[0]
    _check_known(int(times[0]), known)
    times[2] = times[2] or time.process_time()
    print(json.dumps({"samples": times[0] - known, "cpu_s": times[2] - times[1]}), flush=True)
    del subscriber
    os._exit(0)


# --- the table ---------------------------------------------------------------------------------------------------


def start_part(*arguments: object) -> "subprocess.Popen[str]":
    """Start this program as another process and wait until it is ready; its errors come out here."""
    process = subprocess.Popen([sys.executable, __file__, *map(str, arguments)], stdout=subprocess.PIPE, text=True)
    if arguments[0] != "publish":
        line = _line(process)
        assert line == "ready\n", f"{arguments}: 'ready' was expected, got {line!r}"
    return process


def _line(process: "subprocess.Popen[str]") -> str:
    """The next line that a process prints."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        with process:  # closes its pipe
            code = process.wait()
        arguments = " ".join(map(str, process.args[2:] if isinstance(process.args, list) else ()))
        raise SystemExit(f"scale.py {arguments}: ended with {code} and without a result, see above")
    return line


def read_result(process: "subprocess.Popen[str]") -> dict[str, Any]:
    """Read the result that a process prints at its end."""
    found: dict[str, Any] = json.loads(_line(process))
    return found


def row_of(plants: int) -> str:
    """Measure with so many plants."""
    rows = fast_rows(plants)
    expected = plants * rows * SIGNALS
    endpoint = free_endpoint()
    hub = start_part("route", endpoint)
    try:
        rates = {}
        for listener in ("bare", "monitor"):
            process = start_part(listener, endpoint, plants, expected)
            source = start_part("publish", endpoint, plants, rows)
            found = read_result(process)
            source.wait()
            rates[listener] = found["samples"] / found["cpu_s"]
        alone = f"{found['bytes'] / 1000:9.1f} kB" if plants >= 100 else f"{'–':>12}"
        return (
            f"{plants:7,} {found['core']:13,.0f} {rates['monitor']:13,.0f} {rates['bare']:13,.0f} "
            f"{100 * rates['monitor'] / rates['bare']:6.0f} % {alone}"
        )
    finally:
        hub.kill()


def main() -> None:
    """Measure and print."""
    configure_log(logging.WARNING)
    if len(sys.argv) > 1 and sys.argv[1] in ("route", "publish", "monitor", "bare"):
        parts: dict[str, Callable[..., None]] = {"route": route, "publish": publish, "monitor": monitor, "bare": bare}
        command, endpoint, *numbers = sys.argv[1:]
        parts[command](endpoint, *map(int, numbers))
        return
    print("samples a second of one core")
    print(f"{'plants':>7} {'without bus':>13} {'live':>13} {'bare':>13} {'ratio':>8} {'a plant':>12}")
    for plants in [int(item) for item in sys.argv[1:]] or SIZES:
        print(row_of(plants), flush=True)
    print("goal: without bus >= 60,000; live >= 45, 50, 40 % of bare with 1, 100, 1,000; <= 130 kB a plant")


if __name__ == "__main__":
    main()
