"""Which cause, since when, how large: asked when an alarm has been raised.

Every cause of `causes` may have set in as a step or as a ramp. The linearised bank (see `glr_scan`)
tells which come into question and where to begin, and the filters of the models with these causes in them are fitted to
the rows (see `fit`). What is said in the end is the posterior probability of each cause: of

    likelihood(size, onset) p(size) p(onset),

integrated over sizes and onsets, over that of all causes together. The prior of a size is normal and as wide as one
measurement would tell it (the unit information prior of Kass & Wasserman 1995, J. American Statistical Association 90),
so that no cause is preferred for its unit: with n values since the onset the integral over the size is the greatest
likelihood over sqrt(1 + n). That of an onset is even. Of a small fault the integral over the onset is a sum over the
bank's; of a large one its onset is about normal, and the integral is Laplace's. All causes are equally likely
beforehand, and so are that nothing is wrong and that the cause is none of these.

*None of these* is judged by what the best cause leaves. If innovations are larger by a factor than they should be,
row by row or in sums over some rows, that factor's evidence is weighed like that of a cause. Nothing and none of these
together are one suspect, `UNKNOWN`.

Causes that imitate each other share the probability, as they should: no more can be known from these rows.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import exp, inf, isfinite, log, nan

import numpy as np

from monitor_node.isolation.causes import CAUSES
from monitor_node.isolation.error_dynamics import linearisable
from monitor_node.isolation.fit import Fit, Fitter, WayState
from monitor_node.isolation.glr_scan import Bank
from monitor_node.isolation.hypothesis import Hypothesis
from monitor_node.isolation.segment import HUBER
from monitor_node.isolation.window import Row, Window, newest_rows, window_of
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.kalman.step_budget import BudgetExceededError, StepBudget
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import RAMP

UNKNOWN, SENSOR, PROCESS = "unknown", "sensor", "process"

SHARE_OF_RAMPS = 0.3
"""How likely a cause is to grow, beforehand, rather than to set in at once."""

LOOK_STEPS, LOOK_STEPS_A_ROW = 80_000, 200
"""Filter steps that a look may take: so many, and so many more for each row of the window, 200,000 for 600 rows. The
largest faults of the catalogue take up to 180,000. A sensor that shows anything at all would take millions: filters
then lose the plant and begin again row after row, and no cause explains it. The budget is the same however far rows are
apart: a step takes as long on any way, and a look must not. So of rows some minutes apart the last looks at a large
fault, over hundreds of rows, may stop where those of rows 0.1 min apart do not."""

LEAST_ROWS = 100
"""Of rows that are far apart at least so many are looked at, beside two for each row since the first alarm."""

SUMMED_ROWS = (1, 5, 20)
"""Over which innovations are summed, to see whether something is left in them."""


@dataclass(frozen=True)
class Suspect:
    """A cause, and what is known of it if it is the one.

    Attributes:
        cause: its name in the catalogue, or `UNKNOWN`.
        profile: `step` or `ramp`; empty if unknown.
        probability: that it is this cause; over all suspects they sum up to 1.
        size: of a ramp the one that it has reached in the last row; in the effect's unit.
        size_sd: its standard deviation.
        onset_min: when it set in.
        onset_sd_min: standard deviation of that.
        kind: `sensor` or `process`; `UNKNOWN` if unknown.
    """

    cause: str
    profile: str
    probability: float
    size: float
    size_sd: float
    onset_min: float
    onset_sd_min: float
    kind: str


class Isolation:
    """Keeps the newest rows of one plant and, asked, compares all causes on them.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        window_rows: how many of the newest rows are kept.
        effects: the causes; those that bring states of their own are left out.
        excluded: names of causes that do not come into question.

    Attributes:
        budget: of the filter steps of the last look.
        stopped: whether the last look stopped at its budget.
    """

    def __init__(
        self,
        model: ProcessModel,
        noise: NoiseLevels,
        window_rows: int = 600,
        effects: Sequence[Effect] = CAUSES,
        excluded: Sequence[str] = (),
    ) -> None:
        self._rows: deque[Row] = deque(maxlen=window_rows)
        self._effects = linearisable(model, [effect for effect in effects if effect.name not in excluded])
        self._nominal = Filter(model, noise)
        self._bank = Bank(model, noise, self._effects)
        self._fitter = Fitter(model, noise, self._effects)
        self.budget, self.stopped = StepBudget(1), False

    def add(self, time_min: float, input_value: float, measured: Sequence[float]) -> None:
        """Keep a row; NaN where something is missing."""
        self._rows.append((time_min, input_value, measured))

    def clear(self) -> None:
        """Forget all rows."""
        self._rows.clear()
        self._fitter.forget()

    @property
    def way(self) -> WayState | None:
        """How far a fault has been followed: what is remembered beside the rows."""
        return self._fitter.state

    @way.setter
    def way(self, state: WayState | None) -> None:
        self._fitter.restore(state)

    @property
    def steps(self) -> int:
        """Filter steps that a look at the present rows may take."""
        return LOOK_STEPS + LOOK_STEPS_A_ROW * (self._rows.maxlen or len(self._rows))

    @property
    def preparations(self) -> list[Callable[[], None]]:
        """Make all functions and machine code that looks need, so that the first look takes as long as any other.

        They are parts, of some hundredths of a second each, for the first isolation of a model in this process.
        """
        return [self._nominal.prepare, self._bank.prepare, *(item.prepare for item in self._fitter.hypotheses)]

    def suspects(self, not_before_min: float = -inf, since_rows: int = 0) -> list[Suspect]:
        """The causes that come into question, likeliest first, and `UNKNOWN` among them.

        A look stops at a budget of filter steps. `UNKNOWN` is then the only suspect, and `stopped` is set.

        Args:
            not_before_min: nothing was wrong before.
            since_rows: number of rows since the first alarm. Of rows that are far apart older ones are left out, but
                not those in which the fault may have set in.
        """
        self.budget, self.stopped = StepBudget(self.steps), False
        try:
            return self._compared(newest_rows(tuple(self._rows), LEAST_ROWS + 2 * since_rows), not_before_min)
        except BudgetExceededError:  # hypotheses of which some were fitted and some were not cannot be compared
            self.stopped = True
            return [_unknown(1.0)]

    def _compared(self, rows: Sequence[Row], not_before_min: float) -> list[Suspect]:
        self._nominal.budget = self.budget
        window = window_of(rows, self._nominal, not_before_min)
        if window is None:
            return [_unknown(1.0)]
        found_by_bank = self._bank.scan(window)
        fits = [fit for fit in self._fitter.fit(window, *found_by_bank, self.budget) if isfinite(fit.gain)]
        if not fits:  # nothing was measured in which a cause would show, or none can be followed through it
            return [_unknown(1.0)]
        evidence = [self._evidence(fit) for fit in fits]
        none = evidence[0] + _left(fits[0], window)
        top = max(*evidence, none, 0.0)
        weights = [exp(value - top) for value in evidence]
        unknown = exp(none - top) + exp(-top)
        total = sum(weights) + unknown
        found = [_unknown(unknown / total)]
        for effect in self._effects:
            of_cause = [
                place for place, fit in enumerate(fits) if self._fitter.hypotheses[fit.hypothesis].effect is effect
            ]
            if of_cause:
                likeliest = fits[max(of_cause, key=weights.__getitem__)]
                share = sum(weights[place] for place in of_cause) / total
                found.append(_suspect(self._fitter.hypotheses[likeliest.hypothesis], likeliest, share))
        return sorted(found, key=lambda item: -item.probability)

    def _evidence(self, fit: Fit) -> float:
        """Logarithm of how much likelier the rows are with a cause, over all its sizes and onsets."""
        is_ramp = self._fitter.hypotheses[fit.hypothesis].profile is RAMP
        return fit.gain + fit.log_volume + log(SHARE_OF_RAMPS if is_ramp else 1.0 - SHARE_OF_RAMPS)


def _left(fit: Fit, window: Window) -> float:
    """Logarithm of the evidence that more than noise is left since the onset of the best cause, over that of noise."""
    since = int(np.sum(window.time_min < fit.onset_min)) - (window.time_min.size - len(fit.w))
    w = fit.w[max(since, 0) :]
    known = np.isfinite(window.measured[window.time_min.size - len(w) :])
    found = []
    for rows in SUMMED_ROWS:
        whole = slice(len(w) // rows * rows)
        counts = np.sum(known[whole].reshape(-1, rows, w.shape[1]), axis=1)
        sums = np.sum(np.clip(w[whole], -HUBER, HUBER).reshape(-1, rows, w.shape[1]), axis=1)
        n = int(np.sum(counts > 0))
        square = float(np.sum(sums[counts > 0] ** 2 / counts[counts > 0]))
        if n:
            larger = 0.5 * (square - n - n * log(square / n)) if square > n else 0.0
            found.append(larger - 0.5 * log(n))
    return max(found, default=0.0) - log(len(SUMMED_ROWS))


def _suspect(hypothesis: Hypothesis, fit: Fit, probability: float) -> Suspect:
    effect = hypothesis.effect
    kind = SENSOR if effect.location.endswith("_sensor") else PROCESS
    return Suspect(
        effect.name,
        hypothesis.profile.name,
        probability,
        fit.reached,
        fit.reached_sd,
        fit.onset_min,
        fit.onset_sd_min,
        kind,
    )


def _unknown(probability: float) -> Suspect:
    return Suspect(UNKNOWN, "", probability, nan, nan, nan, nan, UNKNOWN)
