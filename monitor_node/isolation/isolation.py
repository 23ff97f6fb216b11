"""Posterior probabilities of the causes of an alarm, each with its size and onset.

Every cause of `causes` may occur as a step or as a ramp. A linearised scan (`glr_scan`) selects the plausible ones and
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
"""

from collections.abc import Callable, Sequence
from math import isfinite, log

from monitor_node.isolation.candidate import BEHIND, Candidate, Progress, ProgressState
from monitor_node.isolation.causes import causes_of
from monitor_node.isolation.fit import Fitter
from monitor_node.isolation.glr_scan import GlrScan
from monitor_node.isolation.live_posterior import MOST_MEMBERS, LivePosterior
from monitor_node.isolation.residual import log_evidence_of_residual
from monitor_node.isolation.suspect import Evidence, Suspect, rank_suspects, unknown_suspect
from monitor_node.isolation.window import Row, Window, newest_rows, window_of
from reactorwatch.diagnosis.fitting.profiles import Ramp, Step
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.kalman.step_budget import BudgetExceededError, StepBudget
from reactorwatch.process.model import ProcessModel

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
        budget: budget of filter steps of the last look.
        stopped: true if the last look stopped at its budget.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, usual_rows: int = 600) -> None:
        self.steps = LOOK_STEPS + LOOK_STEPS_A_ROW * usual_rows
        self._effects = causes_of(model)
        self._nominal = Filter(model, noise)
        self._scan = GlrScan(model, noise, self._effects)
        self._fitter = Fitter(model, noise, self._effects)
        self.budget, self.stopped = StepBudget(1), False
        self._compared: tuple[Window, list[tuple[Candidate, Evidence]]] | None = None

    @property
    def progress(self) -> ProgressState | None:
        """Progress of earlier looks with a large fault, from which the next look resumes."""
        return None if self._fitter.progress is None else self._fitter.progress.state

    @progress.setter
    def progress(self, state: ProgressState | None) -> None:
        self._fitter.progress = None if state is None else Progress.from_state(state, self._effects)

    @property
    def preparations(self) -> list[Callable[[], None]]:
        """Functions that compile all that looks need, so that the first look takes as long as any other.

        Each takes some hundredths of a second for the first isolation of a model in this process.
        """
        live = self.new_live_posterior()
        return [self._nominal.prepare, self._scan.prepare, *self._fitter.preparations, live.prepare]

    def suspects(self, rows: Sequence[Row], since_rows: int = 0) -> list[Suspect]:
        """Compute the plausible causes, most likely first, `UNKNOWN` among them.

        A look stops at a budget of filter steps. `UNKNOWN` is then the only suspect, and `stopped` is set.

        Args:
            rows: rows, oldest first.
            since_rows: number of rows since the first alarm. Of rows that are far apart older ones are left out, but
                not those in which the fault may have begun.
        """
        self.budget, self.stopped, self._compared = StepBudget(self.steps), False, None
        try:
            return self._compare(newest_rows(rows, LEAST_ROWS + 2 * since_rows))
        except BudgetExceededError:  # fitted hypotheses cannot be compared with others that are not
            self.stopped = True
            return [unknown_suspect(1.0)]

    def _compare(self, rows: Sequence[Row]) -> list[Suspect]:
        self._nominal.budget = self.budget
        window = window_of(rows, self._nominal)
        if window is None:
            return [unknown_suspect(1.0)]
        scans = self._scan.scan(window)
        candidates = [item for item in self._fitter.fit(window, *scans, self.budget) if isfinite(item.gain)]
        if not candidates:  # no measurement would show a cause, or every filter diverged
            return [unknown_suspect(1.0)]
        items = [(item, _evidence(item)) for item in candidates]
        self._compared = (window, items)
        none = items[0][1].log_evidence + log_evidence_of_residual(*candidates[0].residual(window))
        return rank_suspects([evidence for _, evidence in items], none)

    def follow(self) -> LivePosterior | None:
        """Start to follow the causes of the last look row by row; None if it compared none."""
        if self._compared is None:
            return None
        window, items = self._compared
        least = max(evidence.log_evidence for _, evidence in items) - BEHIND
        chosen = [item for item in items if item[1].log_evidence >= least][:MOST_MEMBERS]
        try:
            members, without_fault = self._fitter.members(window, chosen)
        except BudgetExceededError:
            return None
        if not members:
            return None
        live = self.new_live_posterior()
        live.start(members, without_fault, window.time_min, window.inputs[-1].tolist())
        return live

    def new_live_posterior(self) -> LivePosterior:
        """Make a live posterior that has not started."""
        return LivePosterior(self._nominal.model, self._nominal.noise, self._effects)


def _evidence(item: Candidate) -> Evidence:
    """A cause with its likelihood ratio to no fault, integrated over sizes and onsets."""
    size, onset_min = item.parameters[:2].tolist()
    profile, share = (Step, 1.0 - SHARE_OF_RAMPS) if item.profile is Step else (Ramp, SHARE_OF_RAMPS)
    log_evidence = item.gain + item.log_volume + item.end_log_volume + log(share)
    return Evidence(item.effect, log_evidence, profile.name, size, item.size_sd, onset_min, item.onset_sd_min)
