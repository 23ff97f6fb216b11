"""The checks of the signals of a plant together: no data, stuck sensors, spikes, values out of range.

None of them needs a model of what a fault looks like in the process, and each raises its alarm at once: a stuck sensor
after as many equal readings as its noise makes impossible, a spike with the value after it, a silence when the next
sample is overdue. The checks there are: `catalogue`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import ANY, SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import Flags, SignalCheck
from monitor_node.signal_checks.catalogue import CHECKS
from monitor_node.signal_checks.spike import SpikeCheck, SpikeState
from monitor_node.signal_checks.stuck import StuckCheck, StuckState
from monitor_node.signal_checks.timeout import DataTimeoutState, SilenceCheck
from reactorwatch.contract.codec import Publication
from reactorwatch.stored_state import StoredState


class SignalChecksState(StoredState, frozen=True, omit_defaults=True):
    """State of the checks of a plant's signals.

    Attributes:
        silences: of the plant, of the input and of each output.
        stuck: of each output; none before the training ends.
        spikes: of each output; None for an output that is not judged; none before the training ends.
        others: the states of the other checks, by name.
    """

    silences: list[DataTimeoutState]
    stuck: list[StuckState]
    spikes: list[SpikeState | None]
    others: dict[str, bytes] = msgspec.field(default_factory=dict)


FIELDS = {SilenceCheck.name: "silences", StuckCheck.name: "stuck", SpikeCheck.name: "spikes"}
"""Checks with a field of their own in `SignalChecksState`. A check without a state has none at all."""


class SignalChecks:
    """Checks the signals of one plant.

    Args:
        config: of the monitor.
        board: the alarms of the plant; those of the signals are declared here.
        ranges: ranges of the input and of each output; None: no bounds are known.
        numbers: numbers of the plant's stages, see `row_step.row_type`; None: the checks have their own.

    Attributes:
        on_row: hook `on_row` of the checks that have it, see `SignalCheck`.
        measured: hook `measured` of the checks that have it.
        on_values: hook `on_values` of the checks that have it.
    """

    CHANCE_ALARMS = sum(check.can_be_false for check in CHECKS)
    """Number of an output's alarms that can be false alarms."""

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        ranges: Sequence[SignalRange] | None = None,
        numbers: NDArray[np.void] | None = None,
    ) -> None:
        self._board, self._outputs = board, config.outputs
        known = ranges or [ANY] * (1 + len(config.outputs))
        self._checks = [check(config, board, known) for check in CHECKS]
        self._silence = next(check for check in self._checks if isinstance(check, SilenceCheck))
        self._stuck = next(check for check in self._checks if isinstance(check, StuckCheck))
        self._spike = next(check for check in self._checks if isinstance(check, SpikeCheck))
        if numbers is not None:
            self._silence.use(numbers["timeouts"][0])
            self._stuck.numbers, self._spike.limits = numbers["stuck"][0], numbers["spike_limits"][0]
        self.on_row: list[Callable[..., list[Publication]]] = self._hooks("on_row")
        self.measured: list[Callable[..., tuple[float, ...]]] = self._hooks("measured")
        self.on_values: list[Callable[..., list[Publication]]] = self._hooks("on_values")
        self._on_residuals: list[Callable[..., Flags]] = self._hooks("on_residuals")

    def _hooks(self, name: str) -> list[Callable[..., Any]]:
        """A hook of those checks that have it."""
        return [
            getattr(check, name)
            for check in self._checks
            if getattr(type(check), name) is not getattr(SignalCheck, name)
        ]

    @property
    def timed_out(self) -> list[bool]:
        """Silence of each signal, the input first."""
        return self._silence.silent

    @property
    def stuck(self) -> list[bool]:
        """Outputs whose sensors are stuck: their readings are no measurements."""
        flags = [check.invalid for check in self._checks if check.invalid]
        return flags[0] if len(flags) == 1 else [any(each) for each in zip(*flags, strict=True)]

    @property
    def is_normal(self) -> bool:
        """True if each check is, see `SignalCheck`."""
        return all(check.is_normal for check in self._checks)

    @property
    def receipts(self) -> NDArray[np.void]:
        """Numbers of the plant's timeout in receive time, shape (1,)."""
        return self._silence.of_plant.receipts

    @property
    def trainings(self) -> list[tuple[dict[int, int], float]]:
        """See `StuckCheck.trainings`."""
        return self._stuck.trainings

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """Learn from the training; arguments as for `SignalCheck.start`."""
        for check in self._checks:
            check.start(values, e, arl0)

    # --- state -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> SignalChecksState:
        """A copy of all that is remembered; the alarms are the board's."""
        states = {check.name: state for check in self._checks if (state := check.state) != b""}
        own = {field: states.pop(name) for name, field in FIELDS.items()}
        return SignalChecksState(**own, others=states)

    def restore(self, state: SignalChecksState, now_ns: int) -> None:
        """Resume from a state of the same settings; the alarms are restored before.

        Args:
            state: the state.
            now_ns: present time, from which the data timeout counts.

        Raises:
            ValueError: the state is damaged, or of other checks.
        """
        outputs = len(self._outputs)
        counts = (len(state.silences) - 2, len(state.stuck) or outputs, len(state.spikes) or outputs)
        if counts != (outputs,) * 3:
            raise ValueError(f"the state must be of {outputs} outputs, got {counts}")
        others = {check.name for check in self._checks if check.name not in FIELDS and check.state != b""}
        if others != set(state.others):
            raise ValueError(f"the state must be of the checks {sorted(others)}, got {sorted(state.others)}")
        for check in self._checks:
            if check.name in FIELDS:
                check.restore(getattr(state, FIELDS[check.name]))
            elif check.name in others:
                check.restore(state.others[check.name])
        self._silence.arm(now_ns)

    # --- rows ------------------------------------------------------------------------------------------------

    def check_residuals(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], publications: list[Publication]
    ) -> Flags:
        """Check the residuals of a row; returns the outputs whose value is quarantined.

        Arguments as for `SignalCheck.on_residuals`.
        """
        if len(self._on_residuals) == 1:
            return self._on_residuals[0](time_ns, e, scales, units, publications)
        flags = [on_residuals(time_ns, e, scales, units, publications) for on_residuals in self._on_residuals]
        return tuple(any(each) for each in zip(*flags, strict=True))

    def restart(self) -> None:
        """Forget what is withheld, as after a gap."""
        for check in self._checks:
            check.on_gap()

    def reset(self) -> None:
        """Drop earlier rows: the publisher was restarted."""
        for check in self._checks:
            check.on_restart()

    def resume_from_alarms(self) -> None:
        """Take as silent what the alarms say is silent: the next sample ends it."""
        self._silence.resume_from_alarms()

    # --- receive time ----------------------------------------------------------------------------------------

    def on_receipt(self, now_ns: int) -> None:
        """Note that something came from the plant."""
        self._silence.of_plant.on_receipt(now_ns)

    @property
    def receipts_ns(self) -> tuple[int | None, int | None]:
        """When something came last, and from when the next spacing is counted; None: what comes next is the first."""
        return self._silence.of_plant.receipts_ns

    @receipts_ns.setter
    def receipts_ns(self, receipts_ns: tuple[int | None, int | None]) -> None:
        self._silence.of_plant.receipts_ns = receipts_ns

    def due_ns(self) -> int | None:
        """When to `check`, unless something comes before; None: there is nothing to wait for."""
        return self._silence.of_plant.due_ns()

    @property
    def deadline_ns(self) -> int | None:
        """Until when the next row is allowed, in the time of the samples."""
        return self._silence.of_plant.deadline_ns()

    def check(self, now_ns: int) -> list[Publication]:
        """Look whether the plant is silent, by the clock of receipt."""
        return self._silence.publish(0, self._silence.of_plant.check(now_ns))

    def declare_timeout(self) -> list[Publication]:
        """Take the plant as silent, as the clock of receipt told it when this was recorded."""
        return self._silence.publish(0, self._silence.of_plant.declare_timeout())
