"""Posterior probabilities of the causes of an alarm, each with its size and onset.

Every cause of `causes` may occur as a step or as a ramp. A linearised scan (`scan`) selects the plausible ones and
their initial sizes and onsets, and the hypotheses of `diagnosis.fitting` are fitted to the rows (`fit`). The result is
the posterior probability of each cause: of

    likelihood(size, onset) p(size) p(onset),

integrated over sizes and onsets, over that of all causes together. The prior of a size is normal and as wide as one
measurement would determine it (the unit information prior of Kass & Wasserman 1995, J. American Statistical Association
90), so that no cause is preferred for its unit: with n values since the onset the integral over the size is the maximum
likelihood over sqrt(1 + n). The prior of an onset is uniform. For a small fault the integral over the onset is a sum
over the scan's onsets; for a large one the onset is about normal, and the integral is Laplace's approximation. All
causes have the same prior probability, and so have the hypotheses that nothing is wrong and that the cause is none of
these.

*None of these* is weighed by the residual of the best cause. If innovations are larger by a factor than they should be,
row by row or in sums over some rows, the evidence for that factor is weighed like that for a cause. Nothing and none of
these together are one suspect, `UNKNOWN`.

Causes that imitate each other share the probability, as they should: these rows do not distinguish them.

A cause that adds a state, or is discontinuous, has no infinitesimal deviation, and is left to a diagnosis of the
record.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import exp, isfinite, log

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.causes.fit import Fitter, log_evidence_of_residual
from monitor_node.causes.scan import Candidate, GlrScan
from monitor_node.causes.window import Row, newest_rows, window_of
from reactorwatch.diagnosis.fitting.profiles import Ramp, Step
from reactorwatch.kalman.batch import BudgetExceededError, StepBudget
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process import own_effects
from reactorwatch.process.effect import Effect, SensorEffect
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.records.record import MINUTE_NS

UNKNOWN = "unknown"
"""Name of a cause that none of the causes here is; it has no size."""

SENSOR, PROCESS = "sensor", "process"
"""Kinds of causes."""


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def causes_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Causes to which alarms of a plant with these equations are traced; empty if it has no effects of its own."""
    traced = (effect for effect in own_effects(model) if effect.is_traced and not effect.is_discontinuous)
    return tuple(effect for effect in traced if effect.extend(model).state_names == model.state_names)


def rank_suspects(candidates: Sequence[Candidate], none: float) -> list[SuspectedCause]:
    """Compute the probability of each cause, most likely first; its size and onset are those of its likeliest profile.

    Args:
        candidates: each cause with each profile; at least one.
        none: logarithm of the evidence that the cause is none of these; that nothing is wrong has evidence 1, and both
            are the suspect `UNKNOWN`.
    """
    evidence = [log_evidence_of(item) for item in candidates]
    top = max(*evidence, none, 0.0)
    weights = [exp(item - top) for item in evidence]
    unknown = exp(none - top) + exp(-top)
    total = sum(weights) + unknown
    suspects = [SuspectedCause(UNKNOWN, unknown / total)]
    for effect in dict.fromkeys(item.effect for item in candidates):
        indices = [index for index, item in enumerate(candidates) if item.effect is effect]
        item = candidates[max(indices, key=weights.__getitem__)]
        size, onset_min = item.parameters[:2].tolist()
        suspects.append(
            SuspectedCause(
                cause=effect.name,
                probability=sum(weights[index] for index in indices) / total,
                profile=(Step if item.profile is Step else Ramp).name,
                size=size,
                size_sd=item.size_sd,
                unit=effect.unit,
                onset_ns=round(onset_min * MINUTE_NS),
                onset_sd_min=item.onset_sd_min,
                kind=SENSOR if isinstance(effect, SensorEffect) else PROCESS,
                text=effect.describe(size),
            )
        )
    return sorted(suspects, key=lambda item: -item.probability)


def log_evidence_of(item: Candidate) -> float:
    """Logarithm of a candidate's likelihood ratio to no fault, integrated over sizes and onsets."""
    share = 1.0 - SHARE_OF_RAMPS if item.profile is Step else SHARE_OF_RAMPS
    return item.gain + item.log_volume + item.end_log_volume + log(share)


SHARE_OF_RAMPS = 0.3
"""Prior probability that a cause grows as a ramp, rather than as a step."""

LOOK_STEPS, LOOK_STEPS_A_ROW = 200_000, 200
"""Filter steps that a look may take: a fixed number, and a number for each usual row; 320,000 for 600 rows. The largest
faults of the catalogue take 290,000. A sensor with arbitrary values may take more: no cause explains it. The budget
does not depend on the sampling period: a step takes equally long in any interval, and the time of a look is limited. So
with rows some minutes apart the later looks at a large fault may stop where those with rows 0.1 min apart do not."""

LEAST_ROWS = 100
"""Minimum number of rows of a look at rows that are far apart, besides two for each row since the first alarm."""


class Isolation:
    """Compares all causes on rows of one plant.

    Args:
        model: process model of the plant.
        noise: noise levels of the plant and its sensors.
        usual_rows: usual number of rows of a look, which its budget depends on.

    Attributes:
        steps: number of filter steps that a look may take.
        fitter: fits causes to the rows; its progress with a large fault is that of earlier looks.
        budget: budget of filter steps of the last look.
        stopped: true if the last look stopped at its budget.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, usual_rows: int = 600) -> None:
        self.steps = LOOK_STEPS + LOOK_STEPS_A_ROW * usual_rows
        self._nominal, effects = Filter(model, noise), causes_of(model)
        self._scan, self.fitter = GlrScan(model, noise, effects), Fitter(model, noise, effects)
        self.budget, self.stopped = StepBudget(1), False

    @property
    def preparations(self) -> list[Callable[[], None]]:
        """Functions that compile all that looks need, so that the first look takes as long as any other.

        Each takes some hundredths of a second for the first isolation of a model in this process.
        """
        return [self._nominal.prepare, self._scan.prepare, *self.fitter.preparations]

    def suspects(self, rows: Sequence[Row], since_rows: int = 0) -> list[SuspectedCause]:
        """Compute the plausible causes, most likely first, `UNKNOWN` among them.

        A look stops at a budget of filter steps. `UNKNOWN` is then the only suspect, and `stopped` is set.

        Args:
            rows: rows, oldest first.
            since_rows: number of rows since the first alarm. Of rows that are far apart older ones are left out, but
                not those in which the fault may have begun.
        """
        self.budget, self.stopped = StepBudget(self.steps), False
        try:
            return self._compare(newest_rows(rows, LEAST_ROWS + 2 * since_rows))
        except BudgetExceededError:  # fitted hypotheses cannot be compared with others that are not
            self.stopped = True
            return [SuspectedCause(UNKNOWN, 1.0)]

    def _compare(self, rows: Sequence[Row]) -> list[SuspectedCause]:
        self._nominal.budget = self.budget
        window = window_of(rows, self._nominal)
        if window is None:
            return [SuspectedCause(UNKNOWN, 1.0)]
        scans = self._scan.scan(window)
        candidates = [item for item in self.fitter.fit(window, *scans, self.budget) if isfinite(item.gain)]
        if not candidates:  # no measurement would show a cause, or every filter diverged
            return [SuspectedCause(UNKNOWN, 1.0)]
        none = log_evidence_of(candidates[0]) + log_evidence_of_residual(*candidates[0].residual(window))
        return rank_suspects(candidates, none)
