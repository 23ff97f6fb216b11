"""Simulated heat exchangers, watched with lasting steps of their measurement.

Records of heat exchangers with one input and one output, a row a second: a liquid that is heated by
condensing steam, its flow a staircase of random levels. Five cells and the wall's heat capacity, a heat transfer that
grows with the flow, a dead time, a steam temperature that wanders, noise and resolution of the sensor. The plants
differ in all of these.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monitor_node.config import WITHOUT_EQUATIONS, MonitorConfig, ReferenceName
from monitor_node.core import Monitor
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Quality, Sample

TRAINING = 1000
CELLS, SUBSTEPS = 5, 4
FOUND_ROWS = 20
SECOND_NS = 10**9
PLANT = "exchanger"


@dataclass(frozen=True)
class Exchanger:
    """Constants of an exchanger."""

    transit_s: float = 12.0  # time in which the liquid passes, at the flow 1
    wall_s: float = 6.0  # time constant of the wall
    transfer: float = 3.2  # number of transfer units at the flow 1
    exponent: float = 0.6  # exponent of the flow in the heat transfer
    dead_s: int = 2  # dead time of the valve
    hold_s: tuple[int, int] = (5, 60)  # shortest and longest time between two moves of the flow
    wander: float = 0.4  # standard deviation of the steam temperature, K; its time constant is 100 s
    noise: float = 0.08  # standard deviation of the sensor's noise, K
    resolution: float = 0.001  # step of its readings, K


def random_exchanger(rng: np.random.Generator) -> Exchanger:
    """Exchanger of random constants."""
    return Exchanger(
        transit_s=rng.uniform(6.0, 25.0),
        wall_s=rng.uniform(3.0, 12.0),
        transfer=rng.uniform(2.8, 3.6),
        exponent=rng.uniform(0.4, 0.8),
        dead_s=int(rng.integers(0, 4)),
        wander=rng.uniform(0.1, 0.8),
        noise=rng.uniform(0.02, 0.15),
        resolution=float(rng.choice([0.001, 0.01, 0.05])),
    )


def simulate(plant: Exchanger, rows: int, rng: np.random.Generator, calm: int = 0) -> tuple[Array, Array]:
    """Simulate an exchanger; returns its flow and the measured temperature at the outlet, degC."""
    holds = rng.integers(*plant.hold_s, rows)
    flow = np.repeat(rng.uniform(0.65, 1.5, rows), holds)[: rows + plant.dead_s]
    flow[:calm] = 1.0 + 0.4 * (flow[:calm] - 1.0)
    wander, steam = 0.0, np.empty(rows)
    keep = np.exp(-1.0 / 100.0)
    for k, shock in enumerate(rng.standard_normal(rows)):
        wander = keep * wander + np.sqrt(1.0 - keep**2) * plant.wander * shock
        steam[k] = 104.0 + wander
    cells, wall = np.full(CELLS, 95.0), np.full(CELLS, 100.0)
    outlet, step = np.empty(rows), 1.0 / SUBSTEPS
    for k in range(rows):
        outlet[k] = cells[-1]
        q = flow[k]
        inward = plant.transfer * q**plant.exponent / plant.transit_s
        for _ in range(SUBSTEPS):
            before = np.concatenate([[25.0], cells[:-1]])
            cells = cells + step * (CELLS * q / plant.transit_s * (before - cells) + inward * (wall - cells))
            wall = wall + step * ((steam[k] - wall) - 0.05 * (wall - cells)) / plant.wall_s
    measured = outlet + plant.noise * rng.standard_normal(rows)
    return flow[plant.dead_s :][:rows], np.round(measured / plant.resolution) * plant.resolution


def config_of(reference: ReferenceName, per_30_days: float | None = None) -> MonitorConfig:
    """Settings of a monitor of an exchanger."""
    return MonitorConfig(
        plant=PLANT,
        inputs=("q",),
        outputs=("th",),
        process=WITHOUT_EQUATIONS,
        reference=reference,
        training_rows=TRAINING,
        false_alarms_per_30_days=per_30_days,
    )


@dataclass
class Result:
    """Results of a plant."""

    reference: str  # kind of the reference
    false_alarms: list[str]  # alarms of the sound record, by name
    delays: dict[float, list[int | None]]  # for each size of a step, the delays of its alarms in rows
    missed: dict[float, list[int]]  # for each size, the onsets whose steps were missed


def watch(flow: Array, measured: Array, config: MonitorConfig, sizes: Sequence[float], onsets: Sequence[int]) -> Result:
    """Watch a sound record, and from each onset on also with a step of each size in the measurement."""
    monitor, alarms, copies, rows = Monitor(config, 0, points=False), [], {}, []
    for k, values in enumerate(zip(flow.tolist(), measured.tolist(), strict=True)):
        rows.append(values)
        if k in onsets:
            copies[k] = monitor.to_bytes()
        alarms += [f"{name}@{k}" for name in _take_row(monitor, k, values)]
    result = Result(monitor.pipeline.reference, alarms, {}, {})
    for size in sizes:
        delays = result.delays[size] = []
        result.missed[size] = []
        for onset, state in copies.items():
            stepped = Monitor(config, 0, points=False)
            stepped.from_bytes(state)
            stepped.on_history_end()
            before = stepped.alarms.has_unexplained
            found = None
            for k in range(onset, min(onset + FOUND_ROWS, len(rows))):
                if _take_row(stepped, k, (rows[k][0], rows[k][1] + size)):
                    found = k - onset + 1
                    break
            if not before:
                delays.append(found)
            if found is None and not before:
                result.missed[size].append(onset)
    return result


def _take_row(monitor: Monitor, row: int, values: tuple[float, float]) -> list[str]:
    """Process a row; returns the alarms that it raises, but for spikes."""
    publications = list[Publication]()
    for signal, value in zip(monitor.config.signals, values, strict=True):
        sample = Sample(time_ns=row * SECOND_NS, sequence=row, value=value, quality=Quality.QUALITY_GOOD)
        publications += monitor.on_sample(signal, sample, 0)
    raised = [
        item.message for item in publications if isinstance(item.message, Alarm) and item.message.event == "raised"
    ]
    return [alarm.alarm for alarm in raised if not alarm.alarm.startswith("spike/")]
