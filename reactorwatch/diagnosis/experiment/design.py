"""The experiment that would tell rivals apart: an input within limits, found by search.

Every input that is tried is first run under every rival, with the full nonlinear equations; if an output comes nearer
to its limits than `MARGIN_SD` standard deviations of its noise under any of them, the input is made smaller, or
dropped. Of those that are left the best is the one that tells apart best the two rivals that it tells apart least
(`reactorwatch.diagnosis.experiment.alternative` has the measure). Pairs that no input tells apart, such as exact twins,
do not count, and are said.

What is designed is a pattern of `PATTERN_ROWS` rows. It is run as often as is needed for every pair to be decided with
the probability `SURE`: at least `FEWEST` times, since in a short record more can be confused than these rivals, and at
most `MOST` times.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.alternative import probability
from reactorwatch.diagnosis.experiment.alternatives import Rivals
from reactorwatch.diagnosis.experiment.input_sequence import QUIET_ROWS, Ends, InputSequence, families, staircase
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.result import LISTED, Apart, Experiment, ExperimentCurves
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained
from reactorwatch.process.model import ProcessModel

MOST_RIVALS = 5

PATTERN_ROWS, FEWEST, MOST = 600, 2, 8
SURE, LIKELY = 0.99, 0.9

SMALLER = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
"""Shares of the range that are tried until the outputs keep their limits."""

FEW = 2
"""So many pairs that it leaves open are named."""

STEPS, ROWS_A_STEP = 8, 60
EXCHANGES = 24
SEED = 11


@dataclass(frozen=True, eq=False)
class _Tried:
    """An input sequence, and the evidence that a pattern of it brings between each pair of rivals."""

    sequence: InputSequence
    evidence: Array


def proposed(
    explained: Sequence[Explained],
    run: Run,
    model: ProcessModel,
    noise: Noise,
    given: Mapping[str, tuple[float, float]],
) -> Experiment | str:
    """An experiment that tells explanations apart, or a sentence that says why there is none.

    Args:
        explained: at least two, the best first; no more than `MOST_RIVALS` of them are looked at.
        run: the record.
        model: without any of their causes.
        noise: of the plant and its sensors.
        given: limits, by signal.
    """
    return ExperimentSearch(Rivals(explained[:MOST_RIVALS], run, model, noise, given, PATTERN_ROWS), model).found()


class ExperimentSearch:
    """Looks for the input that tells rivals apart best.

    Args:
        rivals: with their limits.
        model: without any of their causes.
    """

    def __init__(self, rivals: Rivals, model: ProcessModel) -> None:
        self._rivals, self._model = rivals, model
        self._ends = Ends(*(rivals.limits[model.input_names[0]]), rivals.rest)
        self._ends = self._possible_ends()

    def found(self) -> Experiment | str:
        """The best experiment, or why there is none."""
        tried = [item for item in (self._tried(sequence) for sequence in families(PATTERN_ROWS)) if item is not None]
        if not tried:
            return (
                f"No experiment is proposed: {self._said_limits()} leave {self._model.input_names[0]} no room to move."
            )
        most = MOST * np.max([item.evidence for item in tried], axis=0)
        in_reach = np.array([probability(evidence, evidence) >= LIKELY for evidence in most.tolist()])
        if not np.any(in_reach):
            in_reach = most >= LISTED
        if not np.any(in_reach):
            return self._none_decides()
        best = self._improved(max(tried, key=lambda item: _score(item, in_reach)), in_reach)
        for share in SMALLER:  # what swings meets the second pattern in another phase
            found = self._settled(best.sequence.smaller(share), in_reach)
            if found is not None:
                return found if found.expected_delta_bic >= LISTED else self._none_decides()
        return f"No experiment is proposed: the outputs do not keep {self._said_limits()} for long enough."

    def _settled(self, sequence: InputSequence, in_reach: Array) -> Experiment | None:
        """With as many patterns as are needed, of which each brings the same evidence; None if it leaves the limits."""
        runs = self._rivals.runs(self._levels(sequence, FEWEST))
        if runs is None:
            return None
        found = self._rivals.noncentralities(runs)
        for times in range(FEWEST, MOST + 1):
            values = times * PATTERN_ROWS * len(self._model.outputs)
            apart = [self._apart(pair, found, times / FEWEST, values) for pair in self._rivals.pairs]
            if all(item.probability >= SURE for item, wanted in zip(apart, in_reach.tolist(), strict=True) if wanted):
                break
        levels = self._levels(sequence, times)
        runs = self._rivals.runs(levels)
        return None if runs is None else self._experiment(levels, runs, apart)

    def _experiment(self, levels: Array, runs: Sequence[Run], apart: Sequence[Apart]) -> Experiment:
        time_min = runs[0].time_min - runs[0].time_min[0]
        told = [item for item in apart if item.probability >= LIKELY]
        told = told or [item for item in apart if item.expected_delta_bic >= LISTED] or list(apart)
        hardest = min(told, key=lambda item: item.expected_delta_bic)
        names = dict.fromkeys(name for item in told for name in item.between)
        changes = np.flatnonzero(np.diff(levels, prepend=np.nan))
        item = self._model.inputs[0]
        span_min = self._rivals.period_min * levels.size
        left = [self._said(item.between) for item in apart if item not in told]
        but = f" (but not between {', nor between '.join(left)})" if left else ""
        if len(left) > FEW:
            but = f" ({len(left)} of the {len(apart)} pairs among all of them stay open)"
        would = "would" if hardest.probability >= LIKELY else "might"
        why = (
            f"{span_min:.4g} min with {item.name} stepping between {levels.min():g} and {levels.max():g} {item.unit} "
            f"{would} decide between {self._said(names)}{but}: the two that are hardest to tell apart are expected to "
            f"differ by {hardest.expected_delta_bic:.0f} in BIC, by more than {LISTED:g} with a probability of "
            f"{_percent(hardest.probability)} %."
        )
        curves = {
            rival.name: dict(zip(self._model.output_names, run.measured.T, strict=True))
            for rival, run in zip(self._rivals.members, runs, strict=True)
        }
        return Experiment(
            why=why,
            input=tuple((round(float(time_min[row]), 6), float(levels[row])) for row in changes.tolist()),
            separates=tuple(names),
            expected_delta_bic=hardest.expected_delta_bic,
            probability=hardest.probability,
            signal=item.name,
            span_min=round(span_min, 6),
            limits={name: self._rivals.limits[name] for name in (item.name, *self._model.output_names)},
            apart=tuple(apart),
            predicted={
                rival: {name: (float(values.min()), float(values.max())) for name, values in columns.items()}
                for rival, columns in curves.items()
            },
            curves=ExperimentCurves(time_min, levels, curves),
        )

    def _possible_ends(self) -> Ends:
        """How far the input can go to either side, step by step, before an output comes too near to its limits."""
        ends = self._ends
        reached = []
        for towards in (-1.0, 1.0):
            sequence = staircase(ROWS_A_STEP, STEPS, towards)
            steps = STEPS
            while (
                steps
                and self._rivals.runs(sequence.first(steps).levels(ends, QUIET_ROWS + steps * ROWS_A_STEP)) is None
            ):
                steps -= 1
            reached.append(steps / STEPS)
        low, high = (float(value) for value in ends.levels(np.array([-reached[0], reached[1]])))
        return Ends(low, high, ends.rest)

    def _tried(self, sequence: InputSequence) -> _Tried | None:
        """The sequence as large as the outputs allow, with the evidence that it brings; None if not at all."""
        for share in SMALLER:
            found = self._judged(sequence.smaller(share))
            if found is not None:
                return found
        return None

    def _judged(
        self, sequence: InputSequence, expected: Array | None = None, least: Array | None = None
    ) -> _Tried | None:
        """With the evidence of a pattern.

        Args:
            sequence: the input.
            expected: evidence between each pair; the pairs with little are looked at first.
            least: evidence that each pair has to have.

        Returns:
            None if the outputs leave their limits, or a pair has no more evidence than `least`.
        """
        levels = self._levels(sequence, 1)
        runs = self._rivals.runs(levels)
        if runs is None or np.ptp(levels) == 0.0:
            return None
        evidence = np.zeros(len(self._rivals.pairs)) if expected is None else expected.copy()
        for place in np.argsort(evidence, kind="stable").tolist():
            evidence[place] = self._rivals.unexplained(self._rivals.pairs[place], runs)
            if least is not None and evidence[place] <= least[place] and least[place] > 0.0:
                return None
        return _Tried(sequence, evidence)

    def _improved(self, best: _Tried, in_reach: Array) -> _Tried:
        """By exchanges of parts."""
        random = np.random.default_rng(SEED)
        for _ in range(EXCHANGES):
            sequence = best.sequence.exchanged(random)
            found = self._judged(sequence, best.evidence, np.where(in_reach, _score(best, in_reach), 0.0))
            if found is not None:
                best = found
        return best

    def _apart(self, pair: tuple[int, int], found: dict[tuple[int, int], float], times: float, values: int) -> Apart:
        """Of a pair, with the one of them true that is harder to confirm, if the evidence is so many times as found."""
        one, two = (self._rivals.members[place] for place in pair)
        more = (two.freedom - one.freedom) * (log(values) - 1.0)
        cases = []
        for evidence, price in ((found[pair], more), (found[pair[::-1]], -more)):
            expected = times * evidence + price
            cases.append((expected, probability(expected, times * evidence)))
        return Apart((one.name, two.name), *min(cases))

    def _levels(self, sequence: InputSequence, times: int) -> Array:
        """Of so many patterns."""
        return np.tile(sequence.levels(self._ends, PATTERN_ROWS), times)

    def _none_decides(self) -> str:
        them = self._said(rival.name for rival in self._rivals.members)
        return (
            f"No experiment with {self._model.input_names[0]} can tell {them} apart within {self._said_limits()}, not "
            f"even in {MOST * PATTERN_ROWS * self._rivals.period_min:.4g} min."
        )

    def _said(self, names: Iterable[str]) -> str:
        labels = {rival.name: rival.label for rival in self._rivals.members}
        *first, last = (labels[name] for name in names)
        return f"{', '.join(first)} and {last}" if first else last

    def _said_limits(self) -> str:
        units = {item.name: item.unit for item in self._model.inputs[:1]}
        units |= {item.name: item.unit for item in self._model.outputs}
        parts = [f"{name} {_range(self._rivals.limits[name])} {unit}" for name, unit in units.items()]
        return f"the limits ({', '.join(parts)})"


def _score(item: _Tried, in_reach: Array) -> float:
    """Of the pair that is told apart least, among those that can be."""
    return float(np.min(item.evidence[in_reach]))


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}"


def _percent(share: float) -> str:
    return "over 99" if share > 0.99 else f"{100.0 * share:.0f}"
