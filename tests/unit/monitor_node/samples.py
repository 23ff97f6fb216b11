"""Messages of a plant, made in the test."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from monitor_node.core import Monitor
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import to_time_ns
from tests.tables import UNITS
from tests.unit.process.effect_named import effect_of

PLANT = "cstr"
Rows = NDArray[np.float64]


def leaking_run(size: float, onset_min: float, span_min: float, seed: int) -> tuple[Rows, dict[str, Rows]]:
    """A run whose coolant leaks from the onset on, with noise: times in minutes, and columns."""
    generator = np.random.default_rng(seed)
    rows = int(span_min * 10) + 1
    time_min = np.arange(rows) / 10
    qc = np.repeat(generator.uniform(90, 111, rows // 10 + 1), 10)[:rows]
    model = effect_of("coolant_flow").extend(cstr(), STEP)
    changes = {"coolant_flow.size": size, "coolant_flow.onset": onset_min}
    outputs = Simulator(model).run(time_min, qc, np.array([0.1, 438.54]), changes).outputs
    outputs = outputs + generator.normal(size=outputs.shape) * (0.002, 0.3)
    return time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]}


def sample(signal: str, row: int, time_min: float, value: float) -> Encoded:
    """One sample on the bus."""
    message = Sample(
        time_ns=to_time_ns(time_min), sequence=row, value=value, unit=UNITS[signal], quality=Quality.QUALITY_GOOD
    )
    return encode(Publication(keys.key(PLANT, keys.SAMPLE, signal), message))


def samples(time_min: Rows, columns: dict[str, Rows]) -> Iterator[Encoded]:
    """A run as the plant publishes it."""
    for row, minute in enumerate(time_min):
        for signal, values in columns.items():
            yield sample(signal, row, float(minute), float(values[row]))


def feed_row(monitor: Monitor, number: int, time_ns: int, values: Sequence[float]) -> list[Publication]:
    """Publications of a monitor because of a row, whose values have no units."""
    published = list[Publication]()
    for signal, value in zip(monitor.config.signals, values, strict=True):
        message = Sample(time_ns=time_ns, sequence=number, value=value, quality=Quality.QUALITY_GOOD)
        published += monitor.on_sample(signal, message, 0)
    return published
