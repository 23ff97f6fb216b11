"""Samples of a plant from messages to rows: each is checked, converted to the unit of its signal, and aligned. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import isfinite

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import Aligner, AlignmentMemory, ReplayFilter, Row
from monitor_node.ingest.resampler import Resampler, ResamplerMemory
from monitor_node.ingest.sequence_check import HeldSample, SequenceCheck
from reactorwatch.contract import keys
from reactorwatch.contract.codec import OTHER_VERSION, DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.errors import InputError
from reactorwatch.records.record import LARGEST_VALUE
from reactorwatch.stored_state import Memory
from reactorwatch.units import conversion

USABLE = frozenset({Quality.QUALITY_GOOD, Quality.QUALITY_UNCERTAIN})
"""Qualities of samples that are used."""

LONGEST_EXAMPLE = 300
"""Characters. Senders control this text; truncate it."""

SAME = (1.0, 0.0)
"""Conversion of a unit to itself, or to another spelling of it."""


def reject_reason(signal: str, sample: Sample) -> tuple[str, str]:
    """Reason to reject a sample, and a description of it."""
    if sample.quality == Quality.QUALITY_UNSPECIFIED:
        return "payload", f"{signal}: the sample has no quality, so it is no Sample of reactorwatch"
    if not isfinite(sample.value):
        return "not_finite", f"{signal} is {sample.value} at {sample.time_ns} ns"
    if sample.quality == Quality.QUALITY_BAD:
        return "bad_quality", f"{signal} is marked bad at {sample.time_ns} ns"
    if sample.quality not in USABLE:
        return "bad_quality", f"{signal} has the quality {sample.quality}, which this version does not know"
    return "out_of_range", f"{signal} is {sample.value} at {sample.time_ns} ns: sizes must be below {LARGEST_VALUE:g}"


class SampleUnits:
    """Converts the samples of a plant; those of signals without a unit here are judged in the units that they come in.

    Attributes:
        plain: newest unit by signal that needed no conversion.
    """

    def __init__(self, declared: Mapping[str, str], model_units: Mapping[str, str]) -> None:
        self._wanted, self._declared = {**declared, **model_units}, dict(declared)
        self.plain: dict[str, str] = {}
        self._conversions: dict[tuple[str, str], tuple[float, float] | InputError] = {}

    def convert(self, signal: str, unit: str, value: float) -> tuple[float, str]:
        """Value and unit of a sample.

        Raises:
            InputError: the unit is unknown, or measures another quantity.
        """
        wanted = self._wanted.get(signal, unit)
        scale, offset = SAME if unit == wanted else self._conversion(signal, unit, wanted)
        if (scale, offset) == SAME:
            self.plain[signal] = unit
            return value, unit
        return scale * value + offset, wanted

    def _conversion(self, signal: str, unit: str, wanted: str) -> tuple[float, float]:
        """Scale and offset of a unit, found once for each signal and unit."""
        known = self._conversions.get((signal, unit))
        if known is None:
            try:
                known = conversion(unit or self._declared.get(signal, wanted), wanted, f"sample of {signal}")
            except InputError as error:
                known = error
            # publishers choose the texts
            if len(self._conversions) < 1000:
                self._conversions[signal, unit] = known
        if isinstance(known, InputError):
            raise known
        return known


class UnusableSamples(Memory, kw_only=True):
    """Samples of a plant's own signals that were refused as samples, since the newest that was used.

    Attributes:
        reasons: text of the reason by signal, for signals whose newest sample was refused.
        in_a_row: number of samples refused since the newest usable one of any signal.
    """

    reasons: dict[str, str] = msgspec.field(default_factory=dict)
    in_a_row: int = 0

    def add(self, signal: str, reason: str) -> None:
        """Count a refused sample."""
        self.reasons[signal] = reason[:LONGEST_EXAMPLE]
        self.in_a_row += 1

    def clear(self, signal: str) -> None:
        """Note a usable sample."""
        self.reasons.pop(signal, None)
        self.in_a_row = 0


@dataclass
class RejectCounter:
    """Counter of rejected messages.

    Attributes:
        by_reason: number of rejected messages by reason since the start.
    """

    by_reason: dict[str, int] = field(default_factory=dict)
    _pending_report: dict[str, str] = field(default_factory=dict)
    _last_report_ns: int | None = None

    def add(self, reason: str, example: str) -> None:
        """Count a message; `example` describes it."""
        self.by_reason[reason] = self.by_reason.get(reason, 0) + 1
        if reason not in self._pending_report:
            is_long = len(example) > LONGEST_EXAMPLE
            self._pending_report[reason] = f"{example[:LONGEST_EXAMPLE]}..." if is_long else example

    @property
    def total(self) -> int:
        """Total over all reasons."""
        return sum(self.by_reason.values())

    def report(self, now_ns: int) -> str | None:
        """One line on messages rejected since the last report; None if there are none, or the report is too recent."""
        if not self._pending_report or (
            self._last_report_ns is not None and now_ns - self._last_report_ns < 60_000_000_000
        ):
            return None
        self._last_report_ns = now_ns
        examples = "; ".join(
            f"{reason} ({self.by_reason[reason]} so far): {text}" for reason, text in self._pending_report.items()
        )
        self._pending_report.clear()
        return f"refused messages: {examples}"


class IntakeMemory(Memory, kw_only=True):
    """Memory of an intake beside that of the alignment.

    Attributes:
        runs: sequence checks of the signals, the inputs first.
        units: newest unit by signal.
        heard_from_ns: time of the first accepted sample by signal.
        refused: number of rejected messages by reason.
        unusable: samples refused since the newest usable one.
        resampling: memory of the resampler, if there is one.
    """

    runs: list[SequenceCheck]
    units: dict[str, str]
    heard_from_ns: dict[str, int] = msgspec.field(default_factory=dict)
    refused: dict[str, int] = msgspec.field(default_factory=dict)
    unusable: UnusableSamples = msgspec.field(default_factory=UnusableSamples)
    resampling: ResamplerMemory = msgspec.field(default_factory=ResamplerMemory)


class SampleIntake:
    """Makes rows of the samples of one plant.

    Args:
        config: settings of the monitor.
        model_units: units of the equations by signal.
        memory: memory to start with.
        on_row: called with each row that is ready, and the publications so far.
        on_label: called with signal, time and value of a sample of a signal that is carried along only.

    Attributes:
        memory: what it remembers.
        rejects: rejected messages.
        aligner: makes rows of the samples, and counts them.
        output_units: newest units of the outputs.
    """

    def __init__(
        self,
        config: MonitorConfig,
        model_units: Mapping[str, str],
        memory: IntakeMemory,
        on_row: Callable[[Row, list[Publication]], None],
        on_label: Callable[[str, int, float], None],
    ) -> None:
        self._config, self._on_row, self._on_label = config, on_row, on_label
        known = (*config.signals, *config.carried_signals)
        self._signal_by_key = {keys.key(config.plant, keys.SAMPLE, signal): signal for signal in known}
        self._label_keys = {keys.key(config.plant, keys.SAMPLE, signal) for signal in config.labels}
        self._indices = {signal: index for index, signal in enumerate(config.signals)}
        self._units = SampleUnits(config.units, model_units)
        self.rejects = RejectCounter()
        rule = config.resample_rule
        self.aligner = Aligner(config.signals, config.reorder_rows, awaits_all=rule is not None)
        self._resampler = None if rule is None else Resampler(rule, config.inputs, config.outputs)
        self._use(memory)
        self._replay_filter: ReplayFilter | None = None

    def _use(self, memory: IntakeMemory) -> None:
        self.memory, self.rejects.by_reason = memory, memory.refused
        self.output_units = [memory.units[output] for output in self._config.outputs]
        if self._resampler is not None:
            self._resampler.memory = memory.resampling

    def resume(self, memory: IntakeMemory, alignment: AlignmentMemory) -> None:
        """Resume from memories, which are those that run then.

        Until `end_history`, samples that were processed before are counted as duplicated and dropped.
        """
        self._use(memory)
        self.aligner.memory, self._replay_filter = alignment, ReplayFilter(alignment)

    def end_history(self) -> None:
        """End the history query: from now on no sample is one that was processed before a restart."""
        self._replay_filter = None

    @property
    def awaits_samples(self) -> bool:
        """True if no sample has come since it resumed."""
        return self._replay_filter is not None and not self._replay_filter.has_begun

    def take(self, messages: Sequence[Encoded], publications: list[Publication]) -> bool:
        """Process messages on keys of the plant's samples; returns True if a sample was accepted."""
        is_accepted = False
        for key, payload, encoding, _ in messages:
            signal = self._signal_by_key.get(key)
            if signal is None:
                if key not in self._label_keys:
                    self.rejects.add("unknown_signal", f"{key} is none of {', '.join(self._config.signals)}")
                continue
            # a sample takes some thirty bytes and its unit
            if len(payload) > 1000:
                self.rejects.add("too_large", f"{key}: {len(payload)} bytes are no Sample")
                continue
            try:
                sample = decode(payload, encoding)
            except DecodeError as error:
                if error.reason == OTHER_VERSION:
                    self._refuse(signal, error.reason, str(error))
                else:
                    self.rejects.add(error.reason, f"{key}: {error}")
                continue
            if not isinstance(sample, Sample):
                self.rejects.add("encoding", f"{key}: a Sample was expected, got {encoding}")
            elif self.take_sample(signal, sample, publications):
                is_accepted = True
        return is_accepted

    def take_sample(self, signal: str, sample: Sample, publications: list[Publication]) -> bool:
        """Process a sample of one of the plant's signals; returns True if it was accepted, see `take`."""
        quality, value, unit = sample.quality, sample.value, sample.unit  # each access costs as much as a line here
        if quality not in USABLE or not abs(value) < LARGEST_VALUE:
            self._refuse(signal, *reject_reason(signal, sample))
            return False
        if unit != self._units.plain.get(signal):
            try:
                value, unit = self._units.convert(signal, unit, value)
            except InputError as error:
                self._refuse(signal, "unit", str(error))
                return False
        index, time_ns, number = self._indices.get(signal), sample.time_ns, sample.sequence
        if index is None:
            self._on_label(signal, time_ns, value)
            return False
        if self._replay_filter is not None and self._is_repeated(self._replay_filter, index, time_ns, number):
            return False
        if self.memory.runs[index].accept_next(number, time_ns):  # as nearly always
            self._accept(signal, time_ns, number, value, unit, publications)
            return True
        return self._check_sequence(index, signal, HeldSample(time_ns, number, value, unit), publications)

    def _is_repeated(self, replay_filter: ReplayFilter, index: int, time_ns: int, number: int) -> bool:
        """True if a sample was processed before a restart; without a signal left to filter, the filter ends."""
        is_duplicate = replay_filter.is_duplicate(index, time_ns, number)
        self.aligner.memory.counts.duplicated += is_duplicate
        if replay_filter.is_over:
            self._replay_filter = None
        return is_duplicate

    def _check_sequence(self, index: int, signal: str, sample: HeldSample, publications: list[Publication]) -> bool:
        """Process a sample that is not the expected one of its run; returns True if one was accepted."""
        run, time_ns, number = self.memory.runs[index], sample.time_ns, sample.number
        # sums must still fit into a message
        if not (number < 2**62 and abs(time_ns) < 2**62):
            text = f"{signal} number {number} at {time_ns} ns: no plant counts or lasts so far"
            self.rejects.add("out_of_range", text)
            return False
        may_pause = self._resampler is not None
        accepted, rejected = run.update(sample, self._config.reorder_rows, may_pause=may_pause)
        for item in rejected:
            self.rejects.add(
                "out_of_place",
                f"{signal} number {item.number} at {item.time_ns} ns does not follow number {run.newest} at "
                f"{run.newest_ns} ns; do two plants publish as {self._config.plant}?",
            )
        for item in accepted:
            self._accept(signal, *item, publications)
        return bool(accepted)

    def _refuse(self, signal: str, reason: str, text: str) -> None:
        """Count a sample of one of the plant's signals that cannot be used."""
        self.rejects.add(reason, text)
        if signal in self._indices and reason != "payload":
            self.memory.unusable.add(signal, text)

    def _accept(
        self, signal: str, time_ns: int, number: int, value: float, unit: str, publications: list[Publication]
    ) -> None:
        """Align an accepted sample, and process the rows that are ready."""
        memory = self.memory
        if memory.unusable.reasons:
            memory.unusable.clear(signal)
        if unit != memory.units[signal] or signal not in memory.heard_from_ns:
            memory.heard_from_ns.setdefault(signal, time_ns)
            memory.units[signal] = unit
            self.output_units = [memory.units[output] for output in self._config.outputs]
        for row in self.aligner.update(signal, time_ns, number, value):
            if self._resampler is None:
                self._on_row(row, publications)
            else:
                for made in self._resampler.update(row):
                    self._on_row(made, publications)

    def finish(self, publications: list[Publication]) -> None:
        """Process held samples and pending rows, as at the end of a record."""
        for signal, run in zip(self._config.signals, self.memory.runs, strict=True):
            for sample in run.release():
                self._accept(signal, *sample, publications)
        rows = self.aligner.flush()
        if self._resampler is not None:
            rows = [*chain.from_iterable(map(self._resampler.update, rows)), *self._resampler.flush()]
        for row in rows:
            self._on_row(row, publications)
