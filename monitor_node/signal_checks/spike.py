"""Spike: one value far off, and the next one back. A sensor does that, a process does not.

A process that is disturbed stays disturbed for a while; so a standardised residual beyond `limit` says little until the
next one has come. The first one beyond is withheld: from the charts that have a memory, which it would fill, and from
the correction of a filter, which it would pull. The next value decides:

- it is back: the one withheld was a spike, and is dropped for good; or
- it is still off, on the same side: something has changed. Nothing more is withheld until it is over. All that a
  change loses by this is one sample; or
- it is beyond the limit on the other side: the first was a spike, and this one may be another, and is withheld. A
  third one off, on whichever side, is not withheld: no more than two in a row ever are, so that growing noise or an
  oscillation is not taken for spikes for long.

Back, and over, means within half the limit, so that a change about as large as the limit is not taken for spikes each
time it falls below it.

While an alarm stands whose cause is not known, a fault may have moved the residual for good, and then values about its
new level are no spikes. So as long as it stands, a value is compared with the median of the newest ones, in units of
their median deviation with a margin (but of no less than before), and nothing is a spike until `LEAST_RECENT` of them
are there.

Normal values make a false spike at the rate of a small Markov chain, `false_spike_rate`; since every spike has its own
value beyond the limit, it is never more than P(|z| > limit), and that bound holds for dependent values as well. Where
tails are heavier than normal, `spike_limit` learns a limit from the training: the largest |z| are taken to exceed
their threshold by an exponential excess (Pickands 1975, Statistical inference using extreme order statistics, Annals
of Statistics 3(1), with shape 0), whose mean is estimated with its largest quarter known only as larger (Epstein &
Sobel 1953, Life testing, Journal of the American Statistical Association 48), and given one standard error on top. So
up to one value in a hundred may be a spike in the training, whatever its size, and hardly moves the limit; if more
are, that is how this signal is, and the limit rises until they are none. For tails heavier than exponential there are
more false spikes than promised; but isolated far values are then what the signal has.
"""

from collections import deque
from collections.abc import Sequence
from math import ceil, isfinite, log, sqrt
from statistics import median
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from monitor_node.alarms.annunciator import AlarmBoard
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import Flags, SignalCheck
from reactorwatch.contract.codec import Publication
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement, finite, positive, quantity
from reactorwatch.stored_state import StoredState

BACK = 0.5
"""Of the limit: within it, a value is back."""

RECENT, LEAST_RECENT = 100, 10
"""Newest values with which a value is compared while an alarm stands, at most and at least."""

ERRORS = 3.0
"""Standard errors that the spread of these values may be larger than it looks: about 1 / sqrt(n) each."""

TAIL_SHARE = 0.05
LEAST_TAIL = 10
"""The largest values of the training from which its tail is estimated: this share, and at least so many."""

SEEN_SHARE = 0.75
"""Of these, the smaller ones whose size counts; the others count as larger."""

FEWEST_ROWS = 5 * LEAST_TAIL

_TO_SD = 1.4826  # of the median absolute deviation, for normal values

Phase: TypeAlias = Literal["quiet", "held", "held again", "changed"]


class Verdict(NamedTuple):
    """What a value shows.

    Attributes:
        withhold: whether it is to be kept from filters and charts with a memory; they have a missing sample instead.
        spike: whether the value *before* it was a spike.
        size: that value; 0 if it was none.
    """

    withhold: bool
    spike: bool
    size: float


NO_SPIKE = Verdict(False, False, 0.0)


class SpikeState(StoredState, frozen=True):
    """All that is set and remembered.

    Attributes:
        limit: see `Spike`.
        phase: whether the value before was in (quiet), is withheld, is withheld right after a spike, or was part of a
            change.
        held: the value that is withheld; 0 if none is.
        recent: the newest values since an alarm stands, oldest first; none while none stands.
    """

    limit: float
    phase: Phase
    held: float
    recent: list[float]


class Spike:
    """Tells spikes from changes, in one signal's standardised residuals.

    >>> spike = Spike(limit=6.0)
    >>> [spike.update(z) for z in (0.3, 9.0, -0.5)][1:]
    [Verdict(withhold=True, spike=False, size=0.0), Verdict(withhold=False, spike=True, size=9.0)]
    >>> [spike.update(z).withhold for z in (9.0, 9.0, 9.0)]  # a change
    [True, False, False]

    Args:
        limit: beyond it a value may be a spike, in standard deviations.

    Raises:
        InputError: limit is not a positive number.
    """

    name = "spike"

    def __init__(self, limit: float) -> None:
        self.limit = positive("limit", limit)
        self._phase: Phase = "quiet"
        self._held = 0.0
        self._recent: deque[float] = deque(maxlen=RECENT)

    @classmethod
    def from_state(cls, state: SpikeState) -> "Spike":
        """The one that goes on where `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """
        spike = cls(state.limit)
        spike._phase, spike._held = state.phase, finite(state.held)
        spike._recent.extend(finite(z) for z in state.recent)
        return spike

    @property
    def state(self) -> SpikeState:
        """A copy of all that is set and remembered."""
        return SpikeState(self.limit, self._phase, self._held, list(self._recent))

    def update(self, z: float, *, is_moved: bool = False) -> Verdict:
        """Take the next standardised residual in. A missing one is left out: the next that comes decides.

        Args:
            z: the residual.
            is_moved: whether an alarm stands, so that a fault may have moved the residual.

        Raises:
            ValueError: it is not finite.
        """
        recent = self._recent
        if not is_moved:
            if recent:
                recent.clear()
            return self._decide(z)
        level, spread, is_decided = 0.0, 1.0, recent or self._phase in ("quiet", "changed")
        if len(recent) >= LEAST_RECENT:
            level = median(recent)
            margin = 1.0 + ERRORS / sqrt(len(recent))
            spread = max(1.0, margin * _TO_SD * median(abs(other - level) for other in recent))
        elif is_decided:
            recent.append(finite(z))
            self._phase, self._held = "changed", 0.0
            return NO_SPIKE
        verdict = self._decide((finite(z) - level) / spread)
        if not verdict.withhold:
            recent.append(z)
        return verdict._replace(size=verdict.size * spread)

    def _decide(self, z: float) -> Verdict:
        """The verdict on a residual about 0."""
        if self._phase == "quiet" and abs(z) <= self.limit:  # as nearly always
            return NO_SPIKE
        beyond, back = abs(finite(z)) > self.limit, abs(z) <= BACK * self.limit
        held, self._held = self._held, 0.0
        if self._phase in ("quiet", "changed"):
            if self._phase == "changed" and not back:
                return Verdict(False, False, 0.0)
            self._phase = "held" if beyond else "quiet"
            self._held = z if beyond else 0.0
            return Verdict(beyond, False, 0.0)
        if not back and (self._phase == "held again" or z * held > 0.0):
            self._phase = "changed"
            return Verdict(False, False, 0.0)
        self._phase = "held again" if beyond else "quiet"
        self._held = z if beyond else 0.0
        return Verdict(beyond, True, held)

    def restart(self) -> None:
        """Forget the values seen, as after a gap or a restart of the plant: what was withheld stays undecided."""
        self._phase, self._held = "quiet", 0.0
        self._recent.clear()


def false_spike_rate(limit: float) -> float:
    """How often independent normal values make a spike, a value, in the long run.

    The stationary rate of the Markov chain of `SpikeState.phase`.

    >>> round(1e9 * false_spike_rate(6.0), 2)
    1.97
    """
    beyond = 2.0 * float(ndtr(-limit))
    off = 2.0 * float(ndtr(-BACK * limit))
    # Visits to each phase for one visit to `held`.
    held_again = beyond / 2.0
    changed = (off / 2.0 + held_again * off) / (1.0 - off)
    quiet = 1.0 / beyond
    return (1.0 - off / 2.0 + held_again * (1.0 - off)) / (quiet + 1.0 + held_again + changed)


def spike_limit(z: ArrayLike, arl0: float) -> float:
    """The limit of `Spike` that a training asks for.

    Args:
        z: standardised residuals of a sound plant, shape (rows,), without missing ones; at least 50.
        arl0: values between two false spikes in the mean, at least, if tails are exponential or lighter.

    Returns:
        Never less than normal values ask for.

    Raises:
        InputError: too few values, or one that is not finite, or arl0 is not a number above 1.
    """
    if not 1.0 < arl0 < np.inf:
        raise InputError(f"arl0 must be a number above 1, got {arl0}")
    sizes = np.sort(np.abs(np.asarray(z, dtype=np.float64)))
    if sizes.ndim != 1 or sizes.size < FEWEST_ROWS or not np.isfinite(sizes).all():
        raise InputError(f"z must be at least {FEWEST_ROWS} finite values in a row, got {sizes.size}")
    tail = max(ceil(TAIL_SHARE * sizes.size), LEAST_TAIL)
    threshold = float(sizes[-tail - 1])
    seen = int(SEEN_SHARE * tail)
    excess = sizes[-tail:][:seen] - threshold
    scale = float(excess.sum() + (tail - seen) * excess[-1]) / seen
    learned = threshold + scale * (1.0 + 1.0 / sqrt(seen)) * max(0.0, log(arl0 * tail / sizes.size))
    return max(float(-ndtri(0.5 / arl0)), learned)


class SpikeCheck(SignalCheck):
    """Raises an alarm when an output had a spike, and withholds what may be one."""

    name = Spike.name
    can_be_false = True

    def __init__(self, config: MonitorConfig, board: AlarmBoard, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._alarms = [
            board.declare(self.name, name, at_once=True, priority="low", tells_cause=True, is_passing=True)
            for name in self.outputs
        ]
        self._spikes: list[Spike | None] = []
        self._none = (False,) * len(self.outputs)

    @property
    def state(self) -> list[SpikeState | None]:
        """Of each output; None for an output that is not judged; none before the training ends."""
        return [None if spike is None else spike.state for spike in self._spikes]

    def restore(self, state: list[SpikeState | None]) -> None:
        """See `SignalCheck`."""
        self._spikes = [None if item is None else Spike.from_state(item) for item in state]

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """See `SignalCheck`."""
        known = [[size for size in residuals if isfinite(size)] for residuals in e]
        self._spikes = [Spike(spike_limit(z, arl0)) if len(z) >= FEWEST_ROWS else None for z in known]

    def on_residuals(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], publications: list[Publication]
    ) -> Flags:
        """See `SignalCheck`."""
        flags, is_moved = self._none, self.board.has_unexplained
        for index, spike in enumerate(self._spikes):
            if spike is None or not isfinite(e[index]):
                continue
            alarm, verdict = self._alarms[index], spike.update(e[index], is_moved=is_moved)
            if verdict.withhold:
                flags = (*flags[:index], True, *flags[index + 1 :])
            if verdict.spike or not alarm.at_rest:
                name = self.outputs[index]
                size = verdict.size if verdict.spike else 0.0
                judgement = Judgement(size, 0.0, -spike.limit, spike.limit, verdict.spike)
                spiked = quantity(size * scales[index], units[index], "+.3g")
                text = f"{name} had a spike of {spiked} one row before; it was left out"
                publications += self.judge(alarm, time_ns, judgement, "sd", text, name, cause=self.name)
        return flags

    def on_gap(self) -> None:
        """See `SignalCheck`."""
        for spike in self._spikes:
            if spike is not None:
                spike.restart()
