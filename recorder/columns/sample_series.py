"""Times and values of the samples of one plant, by run and signal. Pure.

Samples are added in batches. Nearly always each sample of a batch continues the current run of its signal: then their
fields are parsed and their order is checked at once (`sample_bytes`). All other batches are added sample by sample.
"""

import math
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, decode, encoding_of
from reactorwatch.contract.sample_bytes import parse_samples, unit_digest
from reactorwatch.records.record import LARGEST_VALUE
from recorder.columns.measurement import measured_value
from recorder.columns.run_splitter import RunSplitter

SAMPLE = encoding_of(messages.Sample)
"""Encoding of samples."""

BATCH = 2048
"""Usual number of samples in a batch: its fixed cost is then small beside that of its samples."""
FIRST_BATCH = 64
"""Number of samples in the first batch: no run has started, so they are added sample by sample."""

_NO_UNIT = unit_digest("")


class SampleSeries:
    """Collects the samples of one plant, in the order of receipt.

    Attributes:
        runs: times and values by signal, for each run; strays are left out.
        units: first unit of each signal that has one.
        splitter: the splitter into runs.
    """

    def __init__(self) -> None:
        self.runs: list[dict[str, tuple[array[int], array[float]]]] = []
        self.units: dict[str, str] = {}
        self.splitter = RunSplitter()
        self._newest: dict[str, tuple[array[int], array[float]]] = {}  # columns of the newest sample, by signal
        self._digests = {_NO_UNIT}  # of units that were decoded

    def add(self, signals: Sequence[str], payloads: Sequence[bytes]) -> None:
        """Add encoded samples; undecodable ones are skipped, as the recorder has counted them as refused.

        Args:
            signals: signal of each sample.
            payloads: bytes of each sample.
        """
        if payloads and not self._add_usual(signals, payloads):
            for signal, payload in zip(signals, payloads, strict=True):
                self._add_sample(signal, payload)

    def _add_usual(self, signals: Sequence[str], payloads: Sequence[bytes]) -> bool:
        """Add samples that all continue the current run; False: some do not, and none was added."""
        columns = parse_samples(payloads)
        if not columns.is_canonical.all() or (columns.quality == messages.QUALITY_UNSPECIFIED).any():
            return False
        if not self._digests.issuperset(np.unique(columns.unit).tolist()):
            return False
        indices = {signal: index for index, signal in enumerate(dict.fromkeys(signals))}
        of_signal = np.fromiter(map(indices.__getitem__, signals), np.int64, len(signals))
        places = {signal: np.flatnonzero(of_signal == index) for signal, index in indices.items()}
        if any(name not in self.units and (columns.unit[at] != _NO_UNIT).any() for name, at in places.items()):
            return False
        stamps = {name: (columns.sequence[at], columns.time_ns[at]) for name, at in places.items()}
        if not self.splitter.continue_run(stamps, columns.time_ns):
            return False
        is_valid = (columns.quality != messages.QUALITY_BAD) & (np.abs(columns.value) < LARGEST_VALUE)
        values = np.where(is_valid, columns.value, math.nan)
        for signal, at in places.items():
            times, numbers = self._columns_of(signal, self.splitter.current)
            times.frombytes(columns.time_ns[at].tobytes())
            numbers.frombytes(values[at].tobytes())
        return True

    def _add_sample(self, signal: str, payload: bytes) -> None:
        try:
            sample: Any = decode(payload, SAMPLE)
        except DecodeError:
            return
        value = measured_value(sample)
        if value is None:
            return
        strays = self.splitter.strays
        number = self.splitter.update(signal, sample.sequence, sample.time_ns)
        if self.splitter.strays > strays:
            for column in self._newest[signal]:
                column.pop()
        if sample.unit and self.units.setdefault(signal, sample.unit):
            self._digests.add(unit_digest(sample.unit))
        times, values = self._columns_of(signal, number)
        times.append(sample.time_ns)
        values.append(value)

    def _columns_of(self, signal: str, number: int) -> tuple["array[int]", "array[float]"]:
        """Times and values of a signal in a run, to which samples are then added."""
        if number > len(self.runs):
            self.runs.append({})
        series = self.runs[number - 1].get(signal)
        if series is None:
            series = self.runs[number - 1][signal] = (array("q"), array("d"))
        self._newest[signal] = series
        return series
