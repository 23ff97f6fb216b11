"""Checks of single signals: stuck sensor, spike, value out of range, no data.

None of them needs a model of faults in the process, and each alarms at once: a stuck sensor after as many equal
readings as its noise makes impossible, a spike with the next value, missing data when the next sample is overdue.
"""

from collections.abc import Sequence
from math import isfinite, nan

from monitor_node.alarms.alarms import STUCK_SENSOR, ChartAlarm, Explanation, SuspectedCause, format_quantity
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import ANY, SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.spike import Spike, SpikeState, spike_limit
from monitor_node.signal_checks.stuck import Stuck, StuckState
from monitor_node.signal_checks.timeout import NO_CHANGE, Change, DataTimeout, DataTimeoutState
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.stored_state import StoredState

PLANT = "plant"
"""Name of all signals together, for the data timeout."""

RANGE, OUT_OF_RANGE = "range", "out_of_range"
"""Alarm of a value outside the possible range of the process, and the cause that it names."""

READINGS, SENSOR = "readings", "sensor"

FEWEST_FOR_SPIKES = 50


class SignalChecksState(StoredState, frozen=True):
    """State of the checks of a plant's signals.

    Attributes:
        silences: data timeouts of the plant, of the input and of each output.
        stuck: one check an output; empty before the training ends.
        spikes: one check an output; None for an output that is not checked.
    """

    silences: list[DataTimeoutState]
    stuck: list[StuckState]
    spikes: list[SpikeState | None]


class SignalChecks:
    """Checks the signals of one plant.

    Args:
        config: settings of the monitor.
        board: alarms of the plant; those of the signals are declared here.
        ranges: possible ranges of the input and of each output; None: unbounded.

    Attributes:
        stuck: one flag an output: its sensor is stuck, and its readings are no measurements.
    """

    CHANCE_ALARMS = 2
    """Number of an output's alarms that can be false alarms."""

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange] | None = None) -> None:
        self._board = board
        self._ranges = list(ranges or [ANY] * (1 + len(config.outputs)))
        outputs = config.outputs
        self._names = (PLANT, config.input, *outputs)
        self._timeouts = [DataTimeout(config.silence_periods) for _ in self._names]
        self._timeout_alarms = [
            board.declare(
                DataTimeout.name, name, without_on_delay=True, without_off_delay=True, priority="high", names_cause=True
            )
            for name in self._names
        ]
        self._outputs = outputs
        self._stuck_alarms = [
            board.declare(Stuck.name, name, without_on_delay=True, names_cause=True) for name in outputs
        ]
        self._spike_alarms = [
            board.declare(Spike.name, name, without_on_delay=True, priority="low", names_cause=True, is_transient=True)
            for name in outputs
        ]
        self._range_alarms = [
            board.declare(RANGE, name, without_on_delay=True, dead_band=0.0, names_cause=True)
            if item.is_bounded
            else None
            for name, item in zip(self._names[1:], self._ranges, strict=True)
        ]
        self._stuck: list[Stuck] = []
        self._spikes: list[Spike | None] = []
        self._none = (False,) * len(outputs)
        self._refresh_stuck()

    @property
    def timed_out(self) -> list[bool]:
        """Active data timeout of each signal, the input first."""
        return [silence.standing for silence in self._timeouts[1:]]

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """Learn limits from the training.

        Args:
            values: readings of each output in order of time; NaN if missing, and for an output that is left out.
            e: prewhitened residuals of each output; NaN if missing.
            arl0: in-control run length of each alarm, in rows.
        """
        self._stuck, self._spikes = [], []
        self._refresh_stuck()
        for readings, residuals in zip(values, e, strict=True):
            stuck = Stuck(arl0)
            for reading in readings:
                if isfinite(reading):
                    stuck.learn(reading)
            self._stuck.append(stuck)
            known = [size for size in residuals if isfinite(size)]
            enough = len(known) >= FEWEST_FOR_SPIKES
            self._spikes.append(Spike(spike_limit(known, arl0)) if enough else None)

    # --- state -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> SignalChecksState:
        """A copy of the state, without the alarms."""
        return SignalChecksState(
            [silence.state for silence in self._timeouts],
            [stuck.state for stuck in self._stuck],
            [None if spike is None else spike.state for spike in self._spikes],
        )

    def restore(self, state: SignalChecksState, now_ns: int) -> None:
        """Resume from a state of the same settings; the alarms are restored before.

        Args:
            state: the state.
            now_ns: present time, from which the data timeout counts.

        Raises:
            ValueError: the state is damaged.
        """
        outputs = len(self._outputs)
        counts = (len(state.silences) - 2, len(state.stuck) or outputs, len(state.spikes) or outputs)
        if counts != (outputs,) * 3:
            raise ValueError(f"the state must be of {outputs} outputs, got {counts}")
        self._timeouts = [DataTimeout.from_state(item) for item in state.silences]
        self._timeouts[0].arm(now_ns)
        self._stuck = [Stuck.from_state(item) for item in state.stuck]
        self._spikes = [None if item is None else Spike.from_state(item) for item in state.spikes]
        self._refresh_stuck()

    # --- rows ------------------------------------------------------------------------------------------------

    def check_timeouts(self, time_ns: int, values: tuple[float, ...]) -> list[Publication]:
        """Check a row for signals without data.

        Args:
            time_ns: time of the row.
            values: values of the input and the outputs; NaN if missing.
        """
        timeouts = self._timeouts
        publications: list[Publication] = []
        change = timeouts[0].update(time_ns, present=True)
        if change is not NO_CHANGE:
            publications += self._update_timeout_alarm(0, change)
            for timeout in timeouts[1:]:
                timeout.suppress_until(time_ns)
        is_complete = all(value == value for value in values)  # NaN is not equal to itself
        fallback_ns = None if is_complete else timeouts[0].fallback_allowed_ns()
        for index, value in enumerate(values, start=1):
            change = timeouts[index].update(time_ns, present=value == value, fallback_allowed_ns=fallback_ns)
            if change is not NO_CHANGE:
                publications += self._update_timeout_alarm(index, change)
        return publications

    def check_ranges(
        self, time_ns: int, values: tuple[float, ...], publications: list[Publication]
    ) -> tuple[float, ...]:
        """Check a row for values out of range; returns the values with NaN in place of these.

        Args:
            time_ns: time of the row.
            values: values of the input and the outputs; NaN if missing.
            publications: list to which changes of alarms are added.
        """
        for index, (value, alarm) in enumerate(zip(values, self._range_alarms, strict=True)):
            if alarm is None or value != value:
                continue
            lower, upper, unit = self._ranges[index]
            if lower <= value <= upper:
                if not alarm.is_idle:
                    inside = Judgement(value, 0.5 * (lower + upper), lower, upper, False)
                    publications += self._evaluate(alarm, time_ns, inside, unit, "", self._names[1 + index], cause="")
                continue
            values = (*values[:index], nan, *values[index + 1 :])
            name, outside = self._names[1 + index], Judgement(value, 0.5 * (lower + upper), lower, upper, True)
            text = (
                f"{name} reads {value:.6g} {unit}, which the process cannot be: a sensor of it shows {lower:g} to "
                f"{upper:g} {unit}; such values are not used as measurements"
            )
            publications += self._evaluate(alarm, time_ns, outside, unit, text, name, cause=OUT_OF_RANGE)
        return values

    def check_stuck(self, time_ns: int, values: list[float], units: list[str]) -> list[Publication]:
        """Check a row for stuck sensors."""
        publications: list[Publication] = []
        for index, value in enumerate(values):
            if not isfinite(value):
                continue
            alarm, judgement = self._stuck_alarms[index], self._stuck[index].update(value)
            if judgement.out or not alarm.is_idle:
                name, times = self._outputs[index], judgement.statistic
                reading = format_quantity(value, units[index], ".6g")
                text = f"{name} is stuck: it has read {reading} {times:.0f} times in a row"
                publications += self._evaluate(alarm, time_ns, judgement, READINGS, text, name, cause=STUCK_SENSOR)
                self._refresh_stuck()
        return publications

    def check_spikes(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], publications: list[Publication]
    ) -> tuple[bool, ...]:
        """Check for spikes; returns the outputs whose values are quarantined.

        Args:
            time_ns: time of the row.
            e: prewhitened residuals; NaN if missing.
            scales: standard deviations in the outputs' units.
            units: units of the outputs.
            publications: list to which changes of alarms are added.
        """
        flags, is_moved = self._none, self._board.has_unexplained
        for index, spike in enumerate(self._spikes):
            if spike is None or not isfinite(e[index]):
                continue
            alarm, verdict = self._spike_alarms[index], spike.update(e[index], is_moved=is_moved)
            if verdict.quarantine:
                flags = (*flags[:index], True, *flags[index + 1 :])
            if verdict.spike or not alarm.is_idle:
                name = self._outputs[index]
                size = verdict.size if verdict.spike else 0.0
                judgement = Judgement(size, 0.0, -spike.limit, spike.limit, verdict.spike)
                spiked = format_quantity(size * scales[index], units[index], "+.3g")
                text = f"{name} had a spike of {spiked} one row before; it was left out"
                publications += self._evaluate(alarm, time_ns, judgement, "sd", text, name, cause="spike")
        return flags

    def restart(self) -> None:
        """Drop quarantined values, as after a gap. Equal readings count across it: a gap makes them no likelier."""
        for spike in self._spikes:
            if spike is not None:
                spike.restart()

    def reset(self) -> None:
        """Drop earlier rows: the publisher was restarted."""
        self.restart()
        for stuck in self._stuck:
            stuck.restart()

    def resume_from_alarms(self) -> None:
        """Resume data timeouts from their alarms: the next sample ends them."""
        for timeout, alarm in zip(self._timeouts, self._timeout_alarms, strict=True):
            timeout.standing = alarm.memory.rule.standing

    # --- receive time ----------------------------------------------------------------------------------------

    def on_receipt(self, now_ns: int) -> None:
        """Restart the plant's timer: a sample was received."""
        self._timeouts[0].on_receipt(now_ns)

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """Receive time of the last sample, and of the one from which the next spacing counts; None before the first."""
        return self._timeouts[0].receipts_ns

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        self._timeouts[0].receipts_ns = receipts_ns

    def due_ns(self) -> int | None:
        """Time to `check`, unless a sample arrives before; None: no timeout is set."""
        return self._timeouts[0].due_ns()

    @property
    def deadline_ns(self) -> int | None:
        """Deadline of the next row in sample time."""
        return self._timeouts[0].deadline_ns()

    def check(self, now_ns: int) -> list[Publication]:
        """Check the plant's data timeout in receive time."""
        change = self._timeouts[0].check(now_ns)
        return self._update_timeout_alarm(0, change) if change is not NO_CHANGE else []

    def declare_timeout(self) -> list[Publication]:
        """Declare a recorded data timeout of the plant."""
        change = self._timeouts[0].declare_timeout()
        return self._update_timeout_alarm(0, change) if change is not NO_CHANGE else []

    # --- within ----------------------------------------------------------------------------------------------

    def _refresh_stuck(self) -> None:
        """Refresh what every row reads and few rows change."""
        self.stuck = [alarm.memory.rule.standing for alarm in self._stuck_alarms]

    def _update_timeout_alarm(self, index: int, change: Change) -> list[Publication]:
        name, alarm = self._names[index], self._timeout_alarms[index]
        publications: list[Publication] = []
        if change.raised_ns is not None:
            text = "no data from the plant" if index == 0 else f"no data of {name}; other signals arrive"
            raised = Judgement(1.0, 0.0, 0.0, 0.0, True)
            publications += self._evaluate(alarm, change.raised_ns, raised, "", text, name, cause="silence")
        if change.cleared_ns is not None:
            over = Judgement(0.0, 0.0, 0.0, 0.0, False)
            publications += self._evaluate(alarm, change.cleared_ns, over, "", "", name, cause="silence")
        return publications

    def _evaluate(
        self, alarm: ChartAlarm, time_ns: int, judgement: Judgement, unit: str, text: str, name: str, *, cause: str
    ) -> list[Publication]:
        def explain(_: Judgement) -> Explanation:
            return Explanation(text, {} if name == PLANT else {name: 1.0}, [SuspectedCause(cause, 1.0, kind=SENSOR)])

        return self._board.evaluate(alarm, time_ns, judgement, unit, explain)
