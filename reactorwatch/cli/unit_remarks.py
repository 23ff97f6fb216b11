"""Remarks on wrong units for commands that work without the plant's equations."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.diagnosis.units import find_wrong_unit
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import to_minutes

MAX_SAMPLES = 3000
"""Samples of each signal from which its unit is checked."""


def unit_remark(model: ProcessModel, columns: Mapping[str, Array], time_min: Array) -> str:
    """Remark on the first unit that is not the model's; empty if there is none.

    Args:
        model: model of the plant.
        columns: values by signal, each of shape (rows,); NaN: not measured.
        time_min: times, shape (rows,).
    """
    wrong = find_wrong_unit(model, columns, time_min)
    return (
        "" if wrong is None else f"{wrong.text}. The plant's equations cannot be its reference; an identified model can"
    )


class FirstSamples:
    """Collects the first samples of a plant from a stream of messages.

    Args:
        plant: name of the plant.
    """

    def __init__(self, plant: str) -> None:
        self._prefix = keys.key(plant, keys.SAMPLE, "")
        self._series: dict[str, list[tuple[int, float]]] = {}

    def collect_samples(self, messages: Iterable[Encoded]) -> Iterator[Encoded]:
        """Yield the messages unchanged, and collect the first samples."""
        for message in messages:
            if message.key.startswith(self._prefix):
                series = self._series.setdefault(message.key.removeprefix(self._prefix), [])
                if len(series) < MAX_SAMPLES:
                    self._collect(message, series)
            yield message

    def _collect(self, message: Encoded, series: list[tuple[int, float]]) -> None:
        try:
            sample = decode(message.payload, message.encoding)
        except DecodeError:
            return  # the monitor counts it as refused
        if isinstance(sample, Sample):
            series.append((sample.time_ns, sample.value))

    def unit_remark(self, model: ProcessModel) -> str:
        """Remark on these samples, see `unit_remark`."""
        columns = {name: np.array([value for _, value in series]) for name, series in self._series.items()}
        times = next(iter(self._series.values()), [])
        return unit_remark(model, columns, np.array([to_minutes(time_ns) for time_ns, _ in times]))
