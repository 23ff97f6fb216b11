"""The plants of a soak, many in a process; started by `site`.

They publish a row each, all at the same time, at their pace, and print the number of the row. Each line of the input
allows rows up to a number, so that the plants do not overtake a disturbance of the network. After the last row they
stay for subscribers that query their history; the end of the input ends them.
"""

import sys
import threading
import time

import msgspec

from benchmarks.harness.site import connect_client
from benchmarks.soak.plan import PERIOD_MIN, draw_plan
from plant_node.node import PlantNode
from plant_node.record import plant_from
from reactorwatch.contract.codec import encode
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.node_main import configure_log

SHARING = 25
"""Plants that share a session: it takes the longer for a message the more keys it has."""


class Task(msgspec.Struct, frozen=True):
    """Task of a process of plants."""

    seed: int  # seed of the plan
    plants: int  # number of plants of the plan
    rows: int  # rows of each plant
    rows_per_s: float  # rows of each plant in a second
    part: int  # index of the first plant of this process; every `parts`-th after it belongs to it as well
    parts: int  # number of such processes
    zero_ns: int  # the time of the first row
    bus: BusConfig  # settings of the link to the router


class Allowance:
    """Rows that may be published, as lines of the input allow."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._rows = 0
        self.ended = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, row: int) -> bool:
        """Wait until a row is allowed; returns whether it is."""
        with self._changed:
            self._changed.wait_for(lambda: row < self._rows or self.ended.is_set())
            return row < self._rows

    def _read(self) -> None:
        for line in sys.stdin:
            with self._changed:
                self._rows = int(line)
                self._changed.notify_all()
        with self._changed:
            self.ended.set()
            self._changed.notify_all()


def publish(task: Task) -> None:
    """Publish the rows of the plants, and stay until the input ends."""
    plan = draw_plan(task.seed, task.plants, task.rows, task.rows_per_s)
    names = plan.plants[task.part :: task.parts]
    configs = [plan.plant(name, task.zero_ns) for name in names]
    nodes = [PlantNode(plant_from(config), config, _nothing) for config in configs]
    buses = [connect_client(task.bus) for _ in range(-(-len(nodes) // SHARING))]
    allowance = Allowance()
    print("ready", flush=True)
    period_ns = round(PERIOD_MIN * MINUTE_NS)
    due_s = time.monotonic()
    for row in range(plan.rows):
        if not allowance.wait_for(row):
            return
        due_s = max(due_s + 1.0 / plan.rows_per_s, time.monotonic() - 1.0)  # what it could not do in time it leaves
        time.sleep(max(0.0, due_s - time.monotonic()))
        for number, node in enumerate(nodes):
            for publication in node.on_tick(task.zero_ns + row * period_ns):
                buses[number // SHARING].publish(encode(publication))
        print(row, flush=True)
    allowance.ended.wait()


def _nothing(_: str) -> None:
    """The seed says what happens."""


if __name__ == "__main__":
    configure_log()
    publish(msgspec.json.decode(sys.argv[1], type=Task))
