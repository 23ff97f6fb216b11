"""Faults of the signals themselves, reported as such: a stuck sensor, a spike, a value out of range, silence.

None of them needs a model of what a fault looks like in the process, and each is told at once: a stuck sensor after as
many equal readings as its noise makes impossible, a spike with the value after it, a silence when the next sample
is overdue.
"""

from collections.abc import Sequence
from math import isfinite, nan

from monitor_node.alarms.alarms import STUCK_SENSOR, ChartAlarm, Explanation, SuspectedCause, quantity
from monitor_node.alarms.annunciator import AlarmBoard
from monitor_node.baseline.signal_range import ANY, SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.spike import Spike, SpikeState, spike_limit
from monitor_node.signal_checks.stuck import Stuck, StuckState
from monitor_node.signal_checks.timeout import NOTHING, Change, Silence, SilenceState
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.stored_state import StoredState

PLANT = "plant"
"""What the silence of all signals together is of."""

RANGE, OUT_OF_RANGE = "range", "out_of_range"
"""The alarm of a signal that shows what the process cannot be, and what its suspect is called."""

READINGS, SENSOR = "readings", "sensor"

FEWEST_FOR_SPIKES = 50


class SignalsState(StoredState, frozen=True):
    """All that was learned and is remembered of the signals of a plant.

    Attributes:
        silences: of the plant, of the input and of each output.
        stuck: of each output; none before the training ends.
        spikes: likewise; None for an output that is not judged.
    """

    silences: list[SilenceState]
    stuck: list[StuckState]
    spikes: list[SpikeState | None]


class SignalWatch:
    """Watches the signals of one plant.

    Args:
        config: of the monitor.
        board: the alarms of the plant; those of the signals are declared here.
        ranges: of the input and of each output; None: no bounds are known.

    Attributes:
        stuck: which outputs' sensors are stuck: what they show is no measurement.
    """

    CHANCE_ALARMS = 2
    """Alarms of one output that chance can raise."""

    def __init__(self, config: MonitorConfig, board: AlarmBoard, ranges: Sequence[SignalRange] | None = None) -> None:
        self._board = board
        self._ranges = list(ranges or [ANY] * (1 + len(config.outputs)))
        outputs = config.outputs
        self._names = (PLANT, config.input, *outputs)
        self._silences = [Silence(config.silence_periods) for _ in self._names]
        self._silent = [
            board.declare(Silence.name, name, at_once=True, over_at_once=True, priority="high", tells_cause=True)
            for name in self._names
        ]
        self._outputs = outputs
        self._stuck_alarms = [board.declare(Stuck.name, name, at_once=True, tells_cause=True) for name in outputs]
        self._spike_alarms = [
            board.declare(Spike.name, name, at_once=True, priority="low", tells_cause=True, is_passing=True)
            for name in outputs
        ]
        self._range_alarms = [
            board.declare(RANGE, name, at_once=True, dead_band=0.0, tells_cause=True) if item.is_bounded else None
            for name, item in zip(self._names[1:], self._ranges, strict=True)
        ]
        self._stuck: list[Stuck] = []
        self._spikes: list[Spike | None] = []
        self._none = (False,) * len(outputs)
        self._note_stuck()

    @property
    def silent(self) -> list[bool]:
        """Silence of each signal, the input first."""
        return [silence.standing for silence in self._silences[1:]]

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """Learn from the training.

        Args:
            values: readings of each output, in order of time; NaN where missing, and in all of an output left out.
            e: prewhitened residuals of each output; NaN where there are none.
            arl0: run length of each alarm without a fault, in rows.
        """
        self._stuck, self._spikes = [], []
        self._note_stuck()
        for readings, residuals in zip(values, e, strict=True):
            stuck = Stuck(arl0)
            for reading in readings:
                if isfinite(reading):
                    stuck.learn(reading)
            self._stuck.append(stuck)
            known = [size for size in residuals if isfinite(size)]
            enough = len(known) >= FEWEST_FOR_SPIKES
            self._spikes.append(Spike(spike_limit(known, arl0)) if enough else None)

    # --- what survives a restart -----------------------------------------------------------------------------

    @property
    def state(self) -> SignalsState:
        """A copy of all that is remembered; the alarms are the board's."""
        return SignalsState(
            [silence.state for silence in self._silences],
            [stuck.state for stuck in self._stuck],
            [None if spike is None else spike.state for spike in self._spikes],
        )

    def restore(self, state: SignalsState, now_ns: int) -> None:
        """Go on where a watch with the same settings was when `state` was taken; after the board.

        Args:
            state: of the other watch.
            now_ns: when the plant is listened to again.

        Raises:
            ValueError: the state is damaged.
        """
        outputs = len(self._outputs)
        counts = (len(state.silences) - 2, len(state.stuck) or outputs, len(state.spikes) or outputs)
        if counts != (outputs,) * 3:
            raise ValueError(f"the state must be of {outputs} outputs, got {counts}")
        self._silences = [Silence.from_state(item) for item in state.silences]
        self._silences[0].listen(now_ns)
        self._stuck = [Stuck.from_state(item) for item in state.stuck]
        self._spikes = [None if item is None else Spike.from_state(item) for item in state.spikes]
        self._note_stuck()

    # --- rows ------------------------------------------------------------------------------------------------

    def hear(self, time_ns: int, values: tuple[float, ...]) -> list[Publication]:
        """Look for silence in a row.

        Args:
            time_ns: of the row.
            values: of the input, then of the outputs; NaN where missing.
        """
        silences = self._silences
        publications: list[Publication] = []
        change = silences[0].update(time_ns, present=True)
        if change is not NOTHING:
            publications += self._tell(0, change)
            for silence in silences[1:]:
                silence.excuse(time_ns)
        is_complete = all(value == value for value in values)  # NaN is not equal to itself
        unknown_ns = None if is_complete else silences[0].unknown_allowed_ns()
        for index, value in enumerate(values, start=1):
            change = silences[index].update(time_ns, present=value == value, unknown_allowed_ns=unknown_ns)
            if change is not NOTHING:
                publications += self._tell(index, change)
        return publications

    def measured(self, time_ns: int, values: tuple[float, ...], publications: list[Publication]) -> tuple[float, ...]:
        """The values of a row, with NaN in place of those that the process cannot have.

        Args:
            time_ns: of the row.
            values: of the input, then of the outputs; NaN where missing.
            publications: changes of alarms are added here.
        """
        for index, (value, alarm) in enumerate(zip(values, self._range_alarms, strict=True)):
            if alarm is None or value != value:
                continue
            lower, upper, unit = self._ranges[index]
            if lower <= value <= upper:
                if not alarm.at_rest:
                    inside = Judgement(value, 0.5 * (lower + upper), lower, upper, False)
                    publications += self._judge(alarm, time_ns, inside, unit, "", self._names[1 + index], cause="")
                continue
            values = (*values[:index], nan, *values[index + 1 :])
            name, outside = self._names[1 + index], Judgement(value, 0.5 * (lower + upper), lower, upper, True)
            text = (
                f"{name} reads {value:.6g} {unit}, which the process cannot be: a sensor of it shows {lower:g} to "
                f"{upper:g} {unit}; such values are not used as measurements"
            )
            publications += self._judge(alarm, time_ns, outside, unit, text, name, cause=OUT_OF_RANGE)
        return values

    def look(self, time_ns: int, values: list[float], units: list[str]) -> list[Publication]:
        """Look for stuck sensors in a row."""
        publications: list[Publication] = []
        for index, value in enumerate(values):
            if not isfinite(value):
                continue
            alarm, judgement = self._stuck_alarms[index], self._stuck[index].update(value)
            if judgement.out or not alarm.at_rest:
                name, times = self._outputs[index], judgement.statistic
                text = f"{name} is stuck: it has read {quantity(value, units[index], '.6g')} {times:.0f} times in a row"
                publications += self._judge(alarm, time_ns, judgement, READINGS, text, name, cause=STUCK_SENSOR)
                self._note_stuck()
        return publications

    def withheld(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str]
    ) -> tuple[tuple[bool, ...], list[Publication]]:
        """Look for spikes in a row; tells which of its values must not enter a memory yet.

        Args:
            time_ns: of the row.
            e: prewhitened residuals; NaN where there are none.
            scales: what one standard deviation is, in the outputs' units.
            units: of the outputs.
        """
        flags, publications, is_moved = self._none, list[Publication](), self._board.has_unexplained
        for index, spike in enumerate(self._spikes):
            if spike is None or not isfinite(e[index]):
                continue
            alarm, verdict = self._spike_alarms[index], spike.update(e[index], is_moved=is_moved)
            if verdict.withhold:
                flags = (*flags[:index], True, *flags[index + 1 :])
            if verdict.spike or not alarm.at_rest:
                name = self._outputs[index]
                size = verdict.size if verdict.spike else 0.0
                judgement = Judgement(size, 0.0, -spike.limit, spike.limit, verdict.spike)
                spiked = quantity(size * scales[index], units[index], "+.3g")
                text = f"{name} had a spike of {spiked} one row before; it was left out"
                publications += self._judge(alarm, time_ns, judgement, "sd", text, name, cause="spike")
        return flags, publications

    def restart(self) -> None:
        """Forget what is withheld, as after a gap. Equal readings are counted on: a gap makes them no likelier."""
        for spike in self._spikes:
            if spike is not None:
                spike.restart()

    def begin_anew(self) -> None:
        """Forget the rows seen: the publisher began again."""
        self.restart()
        for stuck in self._stuck:
            stuck.restart()

    def go_on_from_alarms(self) -> None:
        """Take as silent what the alarms say is silent: the next sample ends it."""
        for silence, alarm in zip(self._silences, self._silent, strict=True):
            silence.standing = alarm.memory.rule.standing

    # --- the clock of receipt --------------------------------------------------------------------------------

    def received(self, now_ns: int) -> None:
        """Note that something came from the plant."""
        self._silences[0].received(now_ns)

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """When something came last, and from when the next spacing is counted; None: what comes next is the first."""
        return self._silences[0].receipts_ns

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        self._silences[0].receipts_ns = receipts_ns

    def due_ns(self) -> int | None:
        """When to `check`, unless something comes before; None: there is nothing to wait for."""
        return self._silences[0].due_ns()

    @property
    def deadline_ns(self) -> int | None:
        """Until when the next row is allowed, in the time of the samples."""
        return self._silences[0].deadline_ns()

    def check(self, now_ns: int) -> list[Publication]:
        """Look whether the plant is silent, by the clock of receipt."""
        change = self._silences[0].check(now_ns)
        return self._tell(0, change) if change is not NOTHING else []

    def fall_silent(self) -> list[Publication]:
        """Take the plant as silent, as the clock of receipt told it when this was recorded."""
        change = self._silences[0].begin()
        return self._tell(0, change) if change is not NOTHING else []

    # --- within ----------------------------------------------------------------------------------------------

    def _note_stuck(self) -> None:
        """What is asked for at every row, and changes seldom."""
        self.stuck = [alarm.memory.rule.standing for alarm in self._stuck_alarms]

    def _tell(self, index: int, change: Change) -> list[Publication]:
        name, alarm = self._names[index], self._silent[index]
        publications: list[Publication] = []
        if change.raised_ns is not None:
            text = "the plant is silent: no sample of it comes" if index == 0 else f"{name} is silent: the others go on"
            raised = Judgement(1.0, 0.0, 0.0, 0.0, True)
            publications += self._judge(alarm, change.raised_ns, raised, "", text, name, cause="silence")
        if change.cleared_ns is not None:
            over = Judgement(0.0, 0.0, 0.0, 0.0, False)
            publications += self._judge(alarm, change.cleared_ns, over, "", "", name, cause="silence")
        return publications

    def _judge(
        self, alarm: ChartAlarm, time_ns: int, judgement: Judgement, unit: str, text: str, name: str, *, cause: str
    ) -> list[Publication]:
        def explain(_: Judgement) -> Explanation:
            return Explanation(text, {} if name == PLANT else {name: 1.0}, [SuspectedCause(cause, 1.0, kind=SENSOR)])

        return self._board.judge(alarm, time_ns, judgement, unit, explain)
