"""Posterior probabilities of the causes of an alarm that follow the stream, row by row, from a look on.

A look (`isolation`) compares the causes on the rows so far. From its last row on, a bank of extended Kalman filters
processes each row: one filter for each plausible cause as the look fitted it, and one for a plant without a fault. The
state of a filter includes the relative size of its cause, so each row refines the size; the onset stays that of the
look. The evidence of a cause grows by the likelihood of its filter's innovations (Magill 1965, Optimal adaptive
estimation of sampled stochastic processes, IEEE Trans. Automatic Control 10), with the loss function of Huber.

A row of all filters takes three calls of compiled functions: 0.25 us for each filter, and 10 us beside. The next look
fits the causes to all rows, and another bank follows.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, inf, isfinite, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.ingest.sampling import missing_rows
from monitor_node.isolation.bank_kernel import NO_FAULT, filter_row, growth, set_rows, set_shares, step_filters
from monitor_node.isolation.bank_model import MOST_SHARE, BankModel, bank_model_of
from monitor_node.isolation.residual import log_evidence_of_sums, sums_dtype, sums_of
from monitor_node.isolation.suspect import Evidence, Suspect, rank_suspects
from monitor_node.isolation.window import GAP_PERIODS
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.codegen.numba_kernel import Entry
from reactorwatch.diagnosis.fitting.profiles import Ramp, Step
from reactorwatch.kalman.ekf import LONGEST_GAP_MIN, NoiseLevels
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import StoredState

MOST_MEMBERS = 24
"""Largest number of causes, each with a profile, that a bank follows."""


class Member(NamedTuple):
    """A cause as a look fitted it.

    Attributes:
        evidence: the cause and its evidence at the look; its size is that in the last row.
        end_min: time at which a ramp ended; infinite if it goes on.
        x: state after the last row, shape (n_x,).
        covariance: covariance of the state for a known size, shape (n_x, n_x).
        slope: derivative of the state by the relative size, shape (n_x,).
        variance: variance of the relative size for a known onset.
        w: normalised innovations since the onset, shape (rows, n_y); 0 where not measured.
        measured: mask of the measured values, shape (rows, n_y).
    """

    evidence: Evidence
    end_min: float
    x: Array
    covariance: Array
    slope: Array
    variance: float
    w: Array
    measured: NDArray[np.bool_]


class LivePosteriorState(StoredState, frozen=True):
    """State of a live posterior.

    Attributes:
        causes: names of all causes, in the order of the indices.
        filters: numbers of the filters, as stored by NumPy.
        time_min: time of the last row.
        period_min: sampling period.
        inputs: last known inputs.
        far: flags of the outputs whose last value was far from every prediction.
        published: probability of each filter, and last that of none, when suspects were published last.
    """

    causes: list[str]
    filters: bytes
    time_min: float
    period_min: float
    inputs: list[float]
    far: list[bool]
    published: list[float]


class LivePosterior:
    """Follows the causes of one plant's alarm.

    Args:
        model: process model of the plant.
        noise: noise levels of the plant and its sensors.
        effects: effects of all causes.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._effects = tuple(effects)
        self._bank: BankModel = bank_model_of(model, self._effects)
        self._constants = self._bank.constants(noise)
        n, n_y = self._bank.n_states, len(model.outputs)
        self._n_y, sums = n_y, sums_dtype(n_y)
        numbers = ("size", "onset_min", "onset_sd_min", "reference_min", "end_min", "largest_share", "log_evidence")
        fields = [
            *((name, "<i8") for name in ("cause", "is_step")),
            *((name, "<f8") for name in numbers),
            ("belief", "<f8", (n + n * n,)),
            *((name, sums[name]) for name in sums.names or ()),
        ]
        self._set_rows, self._step = Entry(set_rows), Entry(step_filters)
        self._filter_row, self._set_shares = Entry(filter_row), Entry(set_shares)
        self._time_min = self._period_min = nan
        self._inputs: list[float] = []
        self._published = np.empty(0)
        self._far = np.zeros(n_y, dtype=np.bool_)
        self._set_filters(np.zeros(0, np.dtype(fields)))

    def _set_filters(self, filters: NDArray[np.void]) -> None:
        """Set the filters, and allocate the arrays of the compiled functions."""
        count = len(filters)
        self._filters = filters
        self._rows = np.empty((count, 2 * self._bank.inputs.size + 3 + 2 * self._n_y))
        self._shares = np.empty(count + 1)

    def prepare(self) -> None:
        """Compile now what the first row would compile; for a posterior that has not started."""
        self._bank.step.prepare()
        log_evidence_of_sums(np.zeros(1, sums_dtype(self._n_y))[0])
        self._set_filters(np.zeros(1, self._filters.dtype))
        self._inputs = [nan] * self._bank.n_inputs
        beliefs, measured = np.zeros((1, self._bank.n_states * (self._bank.n_states + 1))), np.full(self._n_y, nan)
        self._fill_rows(self._inputs, self._inputs, 0.0, 0.0)
        self._step.call(*self._arguments(beliefs, measured))
        self._update_filters(beliefs, measured)
        self.note_published()
        self._set_filters(self._filters[:0])

    def start(
        self, members: Sequence[Member], without_fault: tuple[Array, Array], time_min: Array, inputs: Sequence[float]
    ) -> None:
        """Start after a look.

        Args:
            members: the plausible causes.
            without_fault: state and covariance of the filter of a plant without a fault, after the last row.
            time_min: times of the look's rows.
            inputs: inputs of the last row.
        """
        self._set_filters(np.zeros(len(members) + 1, self._filters.dtype))
        last_min = float(time_min[-1])
        for row, item in zip(self._filters, members, strict=False):
            sums = sums_of(item.w, item.measured)
            cause, known = self._effects.index(item.evidence.effect), item.evidence
            row["cause"], row["is_step"], row["log_evidence"] = cause, known.profile == Step.name, known.log_evidence
            row["size"], row["onset_min"], row["onset_sd_min"] = known.size, known.onset_min, known.onset_sd_min
            row["end_min"], row["reference_min"] = item.end_min, min(item.end_min, last_min)
            row["largest_share"] = _largest_share(known.effect, known.size)
            row["belief"] = _augment(item.x, item.covariance, item.slope, item.variance)
            for name in sums.dtype.names or ():
                row[name] = sums[name]
        nothing = self._filters[-1]
        nothing["cause"], nothing["is_step"], nothing["end_min"] = NO_FAULT, True, inf
        nothing["belief"] = _augment(*without_fault, np.zeros(len(without_fault[0])), 0.0)
        self._time_min, self._period_min = last_min, float(np.median(np.diff(time_min)))
        self._inputs, self._far = list(inputs), np.zeros(self._n_y, dtype=np.bool_)
        self.note_published()

    @property
    def state(self) -> LivePosteriorState:
        """A copy of the state."""
        names, numbers = [effect.name for effect in self._effects], self._filters.tobytes()
        far, published = self._far.tolist(), self._published.tolist()
        return LivePosteriorState(names, numbers, self._time_min, self._period_min, list(self._inputs), far, published)

    def restore(self, state: LivePosteriorState) -> bool:
        """Resume from a state; returns false if it is of other causes or another model.

        Raises:
            ValueError: the state is damaged.
        """
        if state.causes != [effect.name for effect in self._effects] or len(state.far) != self._n_y:
            return False
        self._set_filters(np.frombuffer(state.filters, self._filters.dtype).copy())
        self._time_min, self._period_min = state.time_min, state.period_min
        self._inputs, self._far = list(state.inputs), np.array(state.far, dtype=np.bool_)
        self._published = np.array(state.published)
        return True

    def update(self, time_min: float, inputs: Sequence[float], measured: Sequence[float]) -> bool:
        """Process a row; returns false if the bank ends: after a gap, in which inputs are unknown, or if all diverged.

        Args:
            time_min: time of the row.
            inputs: one value an input; NaN if missing: the last known one then holds.
            measured: values of all sensors; NaN where missing.
        """
        apart = time_min - self._time_min
        if not 0.0 < apart <= min(GAP_PERIODS * self._period_min, LONGEST_GAP_MIN):
            return False
        before = self._inputs
        self._inputs = [now if isfinite(now) else last for now, last in zip(inputs, before, strict=True)]
        lost = missing_rows(apart / self._period_min) if self._inputs != before else 0
        beliefs = self._predict(before, time_min, lost)
        self._time_min = time_min
        if self._update_filters(beliefs, np.array(measured, dtype=float)):
            finite = np.isfinite(self._filters["log_evidence"])  # a filter that has diverged names no cause any more
            self._set_filters(self._filters[finite | (self._filters["cause"] == NO_FAULT)])
        return self._filters.size > 1

    def suspects(self) -> list[Suspect]:
        """Posterior probabilities of the causes, most likely first."""
        filters, n, now = self._filters[:-1], self._bank.n_states, self._time_min
        names = ("cause", "log_evidence", "size", "is_step", "onset_min", "onset_sd_min", "reference_min", "end_min")
        columns = [filters[name].tolist() for name in names]
        shares, variances = filters["belief"][:, n - 1].tolist(), filters["belief"][:, -1].tolist()
        items = []
        for share, variance, cause, log_evidence, size, is_step, onset_min, onset_sd_min, reference_min, end_min in zip(
            shares, variances, *columns, strict=True
        ):
            size_now = size * growth(now, is_step, onset_min, reference_min, end_min)
            size_sd, profile = abs(size_now) * max(variance, 0.0) ** 0.5, (Step if is_step else Ramp).name
            effect = self._effects[cause]
            items.append(Evidence(effect, log_evidence, profile, size_now * share, size_sd, onset_min, onset_sd_min))
        best = int(np.argmax(filters["log_evidence"]))
        none = items[best].log_evidence + log_evidence_of_sums(filters[best])
        return rank_suspects(items, none, float(self._filters["log_evidence"][-1]))

    def has_moved(self, least: float) -> bool:
        """Return true if a probability may have changed by `least` since `note_published`; a quick check."""
        before = self._published
        if before.size != self._filters.size + 1:
            return True
        self._set_shares.call(self._filters, self._shares)
        return float(np.abs(self._shares - before).sum()) >= least

    def note_published(self) -> None:
        """Note that the suspects are published as they are now."""
        self._set_shares.call(self._filters, self._shares)
        self._published = self._shares.copy()

    def _predict(self, before: Sequence[float], time_min: float, lost: int) -> Array:
        """Beliefs at the start of the last piece of an interval; fills the arguments of the compiled step for it.

        If rows were lost, and an input changed, the time of the change is unknown: the predictions for a change at each
        of these rows are mixed, and the last piece has no length.
        """
        start_min, now, beliefs = self._time_min, self._inputs, self._filters["belief"].copy()
        if not lost:
            edges = _edges(start_min, time_min)
            beliefs = self._pass_pieces(beliefs, before, edges[:-1])
            self._fill_rows(before, now, edges[-2], time_min)
            return beliefs
        changes, ends = np.linspace(start_min, time_min, lost + 2)[1:].tolist(), []
        for change_min in changes:
            held = self._pass_pieces(beliefs, before, _edges(start_min, change_min))
            ends.append(self._pass_pieces(held, now, _edges(change_min, time_min)) if change_min < time_min else held)
        n, several = self._bank.n_states, np.array(ends)
        mean = np.mean(several, axis=0)
        apart = several[:, :, :n] - mean[:, :n]
        mean[:, n:] += (np.einsum("efi,efj->fij", apart, apart) / len(ends)).reshape(len(mean), -1)
        self._fill_rows(now, now, time_min, time_min)
        return np.asarray(mean)

    def _pass_pieces(self, beliefs: Array, inputs: Sequence[float], edges: Sequence[float]) -> Array:
        """Predict pieces of two integration steps each, without measurements."""
        for begin, end in pairwise(edges):
            self._fill_rows(inputs, inputs, begin, end)
            beliefs, _ = self._step.call(*self._arguments(beliefs, np.full(self._n_y, nan)))
        return beliefs

    def _fill_rows(self, before: Sequence[float], inputs: Sequence[float], begin_min: float, end_min: float) -> None:
        bank, now = self._bank, np.array(inputs, dtype=float)
        was = np.array(before, dtype=float)
        self._set_rows.call(self._rows, self._filters, bank.inputs, was, now, begin_min, end_min)

    def _update_filters(self, beliefs: Array, measured: Array) -> bool:
        """Correct the filters by a row; returns true if one has diverged."""
        given, share = self._arguments(beliefs, measured), self._bank.n_states - 1
        return bool(self._filter_row.call(self._filters, *given, self._far, share))

    def _arguments(self, beliefs: Array, measured: Array) -> tuple[object, ...]:
        """Leading arguments of `step_filters`."""
        step = self._bank.step
        address = step.lanes_address if len(self._rows) >= LANES else step.address
        return address, beliefs, self._rows, self._constants, measured


def _largest_share(effect: Effect, size: float) -> float:
    """Largest relative size of a cause that is possible."""
    bound = effect.upper if size > 0.0 else effect.lower
    return min(bound / size, MOST_SHARE) if size else 1.0


def _augment(x: Array, covariance: Array, slope: Array, variance: float) -> Array:
    """Belief of a state and a relative size of 1, as one vector."""
    n = x.size
    P = np.empty((n + 1, n + 1))
    P[:n, :n] = covariance + variance * np.outer(slope, slope)
    P[:n, n] = P[n, :n] = variance * slope
    P[n, n] = variance
    return np.concatenate([x, [1.0], P.ravel()])


def _edges(begin_min: float, end_min: float) -> list[float]:
    """Edges of pieces of at most two integration steps; at least one piece."""
    count = max(ceil((end_min - begin_min) / LONGEST_ROW_MIN), 1)
    return [*(begin_min + (end_min - begin_min) * i / count for i in range(count)), end_min]
