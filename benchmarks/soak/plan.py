"""Plan of a soak, drawn from a seed: faults of the plants, and disturbances of the processes.

Time is counted in rows of the plants, which all publish a row at the same time, so that a run is the same on a machine
that is slow.
"""

import random
from itertools import accumulate
from typing import Literal, NamedTuple

from monitor_node.config import MonitorConfig
from plant_node.config import PlantConfig
from reactorwatch.errors import InputError

PERIOD_MIN = 0.1
TRAINING_ROWS = 200
SETTLED_ROWS = 60
"""Rows after the training and before the first fault."""

KNOWN_ROWS = 40
"""Rows after which a monitor knows the numbering and times of the plants; before, it accepts the first publisher."""

LAST_ROWS = 40
"""Rows after the last fault and the last blow."""

FAULTY = 0.25
"""Share of the plants with a fault."""

BLOW_EVERY_S = 25.0
SHORTEST_S, LONGEST_S = 1.0, 6.0
"""Time that a link is cut, or a process gone."""

FAULTS = (
    "coolant_flow:step:-0.2",
    "coolant_flow:step:0.2",
    "feed_temperature:step:10",
    "feed_temperature:step:-10",
    "feed_concentration:step:-0.1",
    "feed_concentration:step:0.1",
    "reaction_rate:step:-0.3",
    "reaction_rate:step:0.3",
    "coolant_temperature:step:10",
    "coolant_temperature:step:-10",
    "temperature_bias:step:5",
    "temperature_bias:step:-5",
    "concentration_bias:step:0.03",
    "concentration_gain:step:0.3",
    "reaction_heat:step:-0.1",
    "feed_flow:step:0.15",
    "activation_energy:step:0.01",
    "heat_loss:step:0.05",
)
"""Faults so large that alarms are raised within five rows and stay active."""

Kind = Literal[
    "kill monitor", "cut monitor", "cut plants", "kill router", "flood",
    "kill worker", "stop worker", "cut worker", "kill client", "kill scheduler",
]  # fmt: skip
Manner = Literal["closed", "stalled"]

KINDS: tuple[tuple[Kind, Manner], ...] = (
    ("kill monitor", "closed"),
    ("cut monitor", "closed"),
    ("cut monitor", "stalled"),
    ("cut plants", "closed"),
    ("cut plants", "stalled"),
    ("kill router", "closed"),
    ("flood", "closed"),
)
"""Disturbances of the processes. Each comes once before any comes again. Only the second monitor is killed, so that the
memory of the first is measured over the whole run."""

CLUSTER_KINDS: dict[Kind, float] = {
    "kill worker": 15.0,
    "stop worker": 30.0,
    "cut worker": 30.0,
    "kill client": 10.0,
    "kill scheduler": 2.0,
}
"""Disturbances of a cluster, with their durations in seconds: how long the process is gone, or its machine stopped or
cut off. Each comes once; those of a worker come again."""

CLUSTER_BLOW_EVERY_S = 50.0

WATCH = MonitorConfig(
    training_min=TRAINING_ROWS * PERIOD_MIN,
    false_alarms_per_30_days=0.05,
    isolation=False,
    state_every_s=2.0,
    health_period_s=2.0,
)
"""Settings of the monitors. With 200 plants over two hours chance raises one alarm in fifty runs. Isolation is off: it
takes a core for a second a plant, and is tested elsewhere."""


class Blow(NamedTuple):
    """A disturbance of a process or a link."""

    row: int  # row of the plants at which it comes
    kind: Kind  # kind of the disturbance
    manner: Manner  # manner of a cut: closed, as when a machine is switched off, or stalled, as when a cable is pulled
    monitor: int  # index of the monitor; of a worker, that of the shard that it runs
    rows: int  # duration in rows


class Fault(NamedTuple):
    """A fault in a plant, with the row of its onset."""

    specification: str
    row: int


class Plan(NamedTuple):
    """Plan of a soak."""

    seed: int  # seed of the plan
    rows: int  # rows of each plant
    rows_per_s: float  # rows of each plant in a second
    plants: tuple[str, ...]  # names of the plants
    faults: dict[str, Fault]  # fault of each plant that has one
    blows: tuple[Blow, ...]  # disturbances in order of time
    shards: int = 0  # number of shards that are placed on a cluster; 0: two monitors are started without one
    monitor: MonitorConfig = WATCH  # settings of the monitors

    def plant(self, name: str, zero_ns: int) -> PlantConfig:
        """Configuration of a plant."""
        fault = self.faults.get(name)
        return PlantConfig(
            name=name,
            period_min=PERIOD_MIN,
            duration_min=self.rows * PERIOD_MIN,
            seed=self.seed + self.plants.index(name),
            zero_ns=zero_ns,
            faults=(f"{fault.specification}@{fault.row * PERIOD_MIN:g}min",) if fault is not None else (),
            health_period_s=3600.0,
        )


def draw_plan(seed: int, plants: int, rows: int, rows_per_s: float, shards: int = 0) -> Plan:
    """Draw a plan; that of a cluster with any number of shards has the same faults."""
    first = TRAINING_ROWS + SETTLED_ROWS
    if rows <= first + LAST_ROWS:
        raise InputError(
            f"a soak must have more than {first + LAST_ROWS} rows of each plant, got {rows}; let it last longer"
        )
    draw = random.Random(seed)
    names = tuple(f"p{number:03d}" for number in range(plants))
    faults = {
        name: Fault(draw.choice(FAULTS), draw.randrange(first, rows - LAST_ROWS))
        for name in sorted(draw.sample(names, round(FAULTY * plants)))
    }
    if shards:
        blows = _draw_cluster_blows(draw, rows, rows_per_s, shards)
        return Plan(seed, rows, rows_per_s, names, faults, blows, shards)
    count = max(len(KINDS), round(rows / rows_per_s / BLOW_EVERY_S))
    share = (rows - LAST_ROWS) / (count + 1)  # the first of these is left in peace
    kinds: list[tuple[Kind, Manner]] = []
    while len(kinds) < count:
        kinds += draw.sample(KINDS, len(KINDS))
    blows = tuple(
        Blow(
            row=round((number + draw.uniform(0.0, 0.5)) * share),
            kind=kind,
            manner=manner,
            monitor=max(draw.randrange(2), int(kind == "kill monitor")),
            rows=round(draw.uniform(SHORTEST_S, LONGEST_S) * rows_per_s),
        )
        for number, (kind, manner) in enumerate(kinds[:count], start=1)
    )
    return Plan(seed, rows, rows_per_s, names, faults, blows)


def _draw_cluster_blows(draw: random.Random, rows: int, rows_per_s: float, shards: int) -> tuple[Blow, ...]:
    """Draw the disturbances of a cluster, with equal pauses, after the training: all plants end theirs at once."""
    kinds = draw.sample(list(CLUSTER_KINDS), len(CLUSTER_KINDS))
    workers = [kind for kind in kinds if kind.endswith("worker")]
    while len(kinds) < round(rows / rows_per_s / CLUSTER_BLOW_EVERY_S):
        kinds.append(workers[len(kinds) % len(workers)])
    first, lengths = TRAINING_ROWS + SETTLED_ROWS, [round(CLUSTER_KINDS[kind] * rows_per_s) for kind in kinds]
    pause = (rows - LAST_ROWS - first - sum(lengths)) // len(kinds)
    if pause < 0:
        raise InputError(f"a soak of a cluster must have {-pause * len(kinds)} more rows of each plant, got {rows}")
    starts = accumulate(lengths, lambda row, length: row + length + pause, initial=first)
    return tuple(
        Blow(row, kind, "closed" if "kill" in kind else "stalled", draw.randrange(shards), length)
        for row, kind, length in zip(starts, kinds, lengths, strict=False)
    )
