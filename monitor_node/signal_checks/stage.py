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
from monitor_node.signal_checks.range import RangeCheck
from monitor_node.signal_checks.spike import Spike, SpikeCheck
from monitor_node.signal_checks.stuck import StuckCheck, StuckState
from monitor_node.signal_checks.timeout import DataTimeoutState, SilenceCheck
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.training_errors import TrainingErrors
from reactorwatch.stored_state import StoredState


class SignalChecksState(StoredState, frozen=True, omit_defaults=True):
    """State of the checks of a plant's signals.

    Attributes:
        silences: state of the plant, of each input and of each output.
        stuck: state of each output; empty before the training ends.
        spikes: check of each output; None for an output without the check; empty before the training ends.
        others: the states of the other checks, by name.
    """

    silences: list[DataTimeoutState]
    stuck: list[StuckState]
    spikes: list[Spike | None]
    others: dict[str, bytes] = msgspec.field(default_factory=dict)


FIELDS = {SilenceCheck.name: "silences", StuckCheck.name: "stuck", SpikeCheck.name: "spikes"}
"""Checks with a field of their own in `SignalChecksState`. A check without a state has none at all."""


class SignalChecks:
    """Checks the signals of one plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; those of the signals are declared here.
        ranges: ranges of each input and of each output; None: no bounds are known.
        numbers: numbers of the plant's stages, see `row_frame.FrameTypes`; None: the checks have their own.
    """

    CHANCE_NAMES = tuple(check.name for check in CHECKS if check.can_be_false)
    """Names of an output's alarms that can be false alarms."""

    CHANCE_ALARMS = len(CHANCE_NAMES)
    """Number of them."""

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        ranges: Sequence[SignalRange] | None = None,
        numbers: NDArray[np.void] | None = None,
    ) -> None:
        self._outputs, self._inputs = config.outputs, config.inputs
        known = ranges or [ANY] * len(config.signals)
        self._checks = [check(config, board, known) for check in CHECKS]
        self.silence = next(check for check in self._checks if isinstance(check, SilenceCheck))
        """The check for missing data, which a receive time can decide as well."""
        self._stuck = next(check for check in self._checks if isinstance(check, StuckCheck))
        if numbers is not None:
            self.silence.use(numbers["timeouts"][0])
            self._stuck.numbers = numbers["stuck"][0]
            next(check for check in self._checks if isinstance(check, SpikeCheck)).limits = numbers["spike_limits"][0]
        self.check_row: Callable[[int, tuple[float, ...]], list[Publication]]
        self.check_row = self._only("on_row", _in_one_list)
        """Checks a row, see `SignalCheck.on_row`."""
        self.mask_values: Callable[[int, tuple[float, ...], list[Publication]], tuple[float, ...]]
        self.mask_values = self._only("measured_values", _one_after_the_other)
        """Masks the values of a row, see `SignalCheck.measured_values`."""
        self.check_values: Callable[[int, list[float], list[str]], list[Publication]]
        self.check_values = self._only("on_values", _in_one_list)
        """Checks the outputs of a row, see `SignalCheck.on_values`."""
        self.check_residuals: Callable[..., Flags] = self._only("on_residuals", _any_of_all)
        """Checks the residuals of a row, see `SignalCheck.on_residuals`."""
        self.invalid: Callable[[], Sequence[bool]] = self._only("invalid", _any_of_all)
        """Outputs whose readings are no measurements, see `SignalCheck.invalid`."""

    def _only(self, name: str, combine: Callable[[list[Callable[..., Any]]], Callable[..., Any]]) -> Callable[..., Any]:
        """A hook of the checks that have it; of a single one the hook itself, since every row passes there."""
        hooks = [
            getattr(check, name)
            for check in self._checks
            if getattr(type(check), name) is not getattr(SignalCheck, name)
        ]
        return hooks[0] if len(hooks) == 1 else combine(hooks)

    @property
    def is_normal(self) -> bool:
        """True if each check is, see `SignalCheck`."""
        return all(check.is_normal for check in self._checks)

    @property
    def trainings(self) -> list[tuple[dict[int, int], float]]:
        """See `StuckCheck.trainings`."""
        return self._stuck.trainings

    def use_ranges(self, ranges: Sequence[SignalRange]) -> None:
        """Take values beyond these ranges for no measurements from now on."""
        for check in self._checks:
            if isinstance(check, RangeCheck):
                check.ranges = ranges

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """Learn from the training; arguments as for `SignalCheck.start`."""
        for check in self._checks:
            check.start(values, e, arl0)

    def relative_rates(
        self, learned: Sequence[Prewhitening], evaluated: Sequence[bool], arl0: float, errors: TrainingErrors
    ) -> Array:
        """Rate of all false alarms by the errors of the training, in shares of one alarm, shape (draws,).

        Args:
            learned: prewhitening of each output.
            evaluated: for each output, True if it is evaluated.
            arl0: run length of each alarm without a fault, in rows.
            errors: errors of all outputs.
        """
        of_checks = (check.relative_rates(learned, arl0, errors) for check in self._checks if check.can_be_false)
        return sum((rates[:, list(evaluated)].sum(axis=1) for rates in of_checks), np.zeros(len(errors.mean)))

    def learn_spike_rates(self, counts: Sequence[int], rows: int, period_ns: float, arl0: float) -> None:
        """Learn how often spikes are usual; arguments as for `SpikeCheck.learn_rates`."""
        for check in self._checks:
            if isinstance(check, SpikeCheck):
                check.learn_rates(counts, rows, period_ns, arl0)

    # --- state -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> SignalChecksState:
        """A copy of the full state; the alarms belong to the board."""
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
        counts = (
            len(state.silences) - 1 - len(self._inputs),
            len(state.stuck) or outputs,
            len(state.spikes) or outputs,
        )
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
        self.silence.arm(now_ns)

    def restore_limits(self, state: SignalChecksState) -> None:
        """Restore what was learned in a training; the data timeouts stay as they are."""
        for check in self._checks:
            if check.name in FIELDS and check is not self.silence:
                check.restore(getattr(state, FIELDS[check.name]))
            elif check.name in state.others:
                check.restore(state.others[check.name])

    # --- rows ------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Forget what is withheld, as after a gap."""
        for check in self._checks:
            check.on_gap()

    def reset(self) -> None:
        """Drop earlier rows: the publisher was restarted."""
        for check in self._checks:
            check.on_restart()


def _in_one_list(hooks: list[Callable[..., list[Publication]]]) -> Callable[..., list[Publication]]:
    return lambda *row: [item for hook in hooks for item in hook(*row)]


def _any_of_all(hooks: list[Callable[..., Flags]]) -> Callable[..., Flags]:
    def check(*row: Any) -> Flags:
        return tuple(any(flags) for flags in zip(*[hook(*row) for hook in hooks], strict=True))

    return check


def _one_after_the_other(hooks: list[Callable[..., tuple[float, ...]]]) -> Callable[..., tuple[float, ...]]:
    def mask(time_ns: int, values: tuple[float, ...], publications: list[Publication]) -> tuple[float, ...]:
        for hook in hooks:
            values = hook(time_ns, values, publications)
        return values

    return mask
