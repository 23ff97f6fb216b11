"""Design of an input within limits that separates alternatives, found by search.

Every candidate input is simulated under every alternative with the full nonlinear equations. If an output comes nearer
to its limits than `MARGIN_SD` standard deviations of its noise under any of them, the input is shrunk or dropped. Of
the rest, the best maximises the evidence between the pair that it separates least
(`reactorwatch.diagnosis.experiment.predictions` defines the evidence). Pairs that no input separates, such as exact
twins, do not count, and are reported.

One input is moved, and the others rest: the one that separates the most pairs and, among equals, the pair that is
separated least the furthest in the same time.

The design is a pattern of `PATTERN_ROWS` rows. It is repeated until every pair is decided with the probability `SURE`:
at least `FEWEST` times, since in a short record more than these alternatives can be confused, and at most `MOST` times.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.inputs import (
    QUIET_ROWS,
    InputRange,
    InputSequence,
    initial_sequences,
    staircase,
)
from reactorwatch.diagnosis.experiment.predictions import Predictions, decision_probability
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.result import LISTED, Experiment, ExperimentCurves, Separation
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.model import ProcessModel
from reactorwatch.sentences.numbers import odds

MOST_ALTERNATIVES = 5

PATTERN_ROWS, FEWEST, MOST = 600, 2, 8
SURE, LIKELY = 0.99, 0.9

SMALLER = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
"""Fractions of the range that are tried until the outputs keep their limits."""

FEW = 2
"""Maximum number of undecided pairs that are named."""

STEPS, ROWS_A_STEP = 8, 60
EXCHANGES = 24
SEED = 11


@dataclass(frozen=True, eq=False)
class _Trial:
    """An input sequence, and the evidence of one pattern between each pair of alternatives."""

    sequence: InputSequence
    evidence: Array


def propose_experiment(
    hypotheses: Sequence[FittedHypothesis],
    run: Run,
    model: ProcessModel,
    noise: Noise,
    given: Mapping[str, tuple[float, float]],
) -> Experiment | str:
    """Propose an experiment that separates explanations, or return a sentence that says why there is none.

    Args:
        hypotheses: at least two fitted hypotheses, the best first; at most `MOST_ALTERNATIVES` are considered.
        run: the record.
        model: process model without their causes.
        noise: noise levels of the plant and its sensors.
        given: limits by signal.
    """
    if not model.inputs:
        return "No experiment is proposed: the process has no input that could be moved."
    predictions = Predictions(hypotheses[:MOST_ALTERNATIVES], run, model, noise, given, PATTERN_ROWS)
    searches = [_ExperimentSearch(predictions, model, index) for index in range(len(model.inputs))]
    searches, limits = [item for item in searches if item.trials], _describe_limits(predictions, model)
    if not searches:
        names = _list_names(model.input_names)
        return f"No experiment is proposed: {limits} leave {names} no room to move."
    in_reach = [item for item in searches if np.any(item.in_reach)]
    found: list[Experiment | None] = []
    for item in sorted(in_reach, key=_ExperimentSearch.reach, reverse=True):
        found.append(item.design())
        if (experiment := found[-1]) is not None and experiment.expected_delta_bic >= LISTED:
            return experiment
    if None in found:
        return f"No experiment is proposed: the outputs do not keep {limits} for long enough."
    labels, longest_min = [item.label for item in predictions.members], MOST * PATTERN_ROWS * predictions.period_min
    return (
        f"No experiment with {_list_names(model.input_names, 'or')} can tell {_list_names(labels)} apart within "
        f"{limits}, not even in {longest_min:.4g} min."
    )


class _ExperimentSearch:
    """Search for the sequence of one input that separates alternatives best.

    Attributes:
        trials: initial sequences, as large as the outputs allow.
        in_reach: for each pair of alternatives, True if the longest experiment is likely to separate it.
    """

    def __init__(self, alternatives: Predictions, model: ProcessModel, moved: int) -> None:
        self._alternatives, self._model, self._moved = alternatives, model, moved
        self._ends = InputRange(*alternatives.limits[model.input_names[moved]], float(alternatives.rest[moved]))
        self._ends = self._possible_ends()
        trials = (self._evaluate_within_limits(sequence) for sequence in initial_sequences(PATTERN_ROWS))
        self.trials = [item for item in trials if item is not None]
        self.in_reach = np.zeros(len(alternatives.pairs), dtype=bool)
        if self.trials:
            most = MOST * np.max([item.evidence for item in self.trials], axis=0)
            self.in_reach = np.array([decision_probability(value, value) >= LIKELY for value in most.tolist()])
            if not np.any(self.in_reach):
                self.in_reach = most >= LISTED

    def reach(self) -> tuple[int, float]:
        """Number of pairs in reach, and the evidence of the one that the best sequence separates least."""
        return int(np.sum(self.in_reach)), _score(self._best_trial(), self.in_reach)

    def _best_trial(self) -> _Trial:
        return max(self.trials, key=lambda item: _score(item, self.in_reach))

    def design(self) -> Experiment | None:
        """Design the experiment; None if the outputs do not keep their limits for long enough."""
        best = self._improve(self._best_trial(), self.in_reach)
        for share in SMALLER:  # a sine meets the second pattern in another phase
            found = self._size_experiment(best.sequence.shrink(share), self.in_reach)
            if found is not None:
                return found
        return None

    def _size_experiment(self, sequence: InputSequence, in_reach: Array) -> Experiment | None:
        """Repeat the pattern as often as needed, each with the same evidence; None if outputs leave their limits."""
        runs = self._alternatives.runs(self._levels(sequence, FEWEST), self._moved)
        if runs is None:
            return None
        noncentralities = self._alternatives.noncentralities(runs)
        for times in range(FEWEST, MOST + 1):
            values = times * PATTERN_ROWS * len(self._model.outputs)
            apart = [
                self._separation(pair, noncentralities, times / FEWEST, values) for pair in self._alternatives.pairs
            ]
            if all(item.probability >= SURE for item, wanted in zip(apart, in_reach.tolist(), strict=True) if wanted):
                break
        levels = self._levels(sequence, times)
        runs = self._alternatives.runs(levels, self._moved)
        return None if runs is None else self._experiment(levels, runs, apart)

    def _experiment(self, levels: Array, runs: Sequence[Run], apart: Sequence[Separation]) -> Experiment:
        time_min = runs[0].time_min - runs[0].time_min[0]
        decided = [item for item in apart if item.probability >= LIKELY]
        decided = decided or [item for item in apart if item.expected_delta_bic >= LISTED] or list(apart)
        hardest = min(decided, key=lambda item: item.expected_delta_bic)
        names = dict.fromkeys(name for item in decided for name in item.between)
        changes = np.flatnonzero(np.diff(levels, prepend=np.nan))
        item = self._model.inputs[self._moved]
        span_min = self._alternatives.period_min * levels.size
        undecided = [self._list_labels(item.between) for item in apart if item not in decided]
        but = f" (but not between {', nor between '.join(undecided)})" if undecided else ""
        if len(undecided) > FEW:
            but = f" ({len(undecided)} of the {len(apart)} pairs among all of them stay open)"
        would = "would" if hardest.probability >= LIKELY else "might"
        why = (
            f"{span_min:.4g} min with {item.name} stepping between {levels.min():g} and {levels.max():g} {item.unit} "
            f"{would} decide between {self._list_labels(names)}{but}: the two that are hardest to tell apart "
            f"would be apart by odds of over {odds(LISTED)} with a probability of {_percent(hardest.probability)} %."
        )
        curves = {
            alternative.name: dict(zip(self._model.output_names, run.measured.T, strict=True))
            for alternative, run in zip(self._alternatives.members, runs, strict=True)
        }
        moves = tuple((round(float(time_min[row]), 6), float(levels[row])) for row in changes.tolist())
        resting = zip(self._model.input_names, self._alternatives.rest.tolist(), strict=True)
        by_input = {name: ((0.0, level),) for name, level in resting} | {item.name: moves}
        return Experiment(
            why=why,
            input=moves if len(by_input) == 1 else by_input,
            separates=tuple(names),
            expected_delta_bic=hardest.expected_delta_bic,
            probability=hardest.probability,
            signal=item.name,
            span_min=round(span_min, 6),
            limits={name: self._alternatives.limits[name] for name in (item.name, *self._model.output_names)},
            separations=tuple(apart),
            predicted={
                alternative: {name: (float(values.min()), float(values.max())) for name, values in columns.items()}
                for alternative, columns in curves.items()
            },
            curves=ExperimentCurves(time_min, levels, curves),
        )

    def _possible_ends(self) -> InputRange:
        """Reach of the input to either side, step by step, until an output comes too near to its limits."""
        ends = self._ends
        reached = []
        for towards in (-1.0, 1.0):
            sequence = staircase(ROWS_A_STEP, STEPS, towards)
            for steps in range(STEPS, -1, -1):
                levels = sequence.first(steps).levels(ends, QUIET_ROWS + steps * ROWS_A_STEP)
                if not steps or self._alternatives.runs(levels, self._moved) is not None:
                    break
            reached.append(steps / STEPS)
        low, high = (float(value) for value in ends.levels(np.array([-reached[0], reached[1]])))
        return InputRange(low, high, ends.rest)

    def _evaluate_within_limits(self, sequence: InputSequence) -> _Trial | None:
        """Evaluate the sequence as large as the outputs allow; None if it cannot be used."""
        for share in SMALLER:
            noncentralities = self._evaluate(sequence.shrink(share))
            if noncentralities is not None:
                return noncentralities
        return None

    def _evaluate(
        self, sequence: InputSequence, expected: Array | None = None, least: Array | None = None
    ) -> _Trial | None:
        """Evidence of one pattern; pairs with little are evaluated first.

        None if the outputs leave their limits, or a pair has no more evidence than `least`.
        """
        levels = self._levels(sequence, 1)
        runs = self._alternatives.runs(levels, self._moved)
        if runs is None or np.ptp(levels) == 0.0:
            return None
        evidence = np.zeros(len(self._alternatives.pairs)) if expected is None else expected.copy()
        for index in np.argsort(evidence, kind="stable").tolist():
            true, other = self._alternatives.pairs[index]
            evidence[index] = self._alternatives.members[other].noncentrality(runs[true])
            if least is not None and evidence[index] <= least[index] and least[index] > 0.0:
                return None
        return _Trial(sequence, evidence)

    def _improve(self, best: _Trial, in_reach: Array) -> _Trial:
        """Improve by random exchanges."""
        random = np.random.default_rng(SEED)
        for _ in range(EXCHANGES):
            sequence = best.sequence.exchange(random)
            noncentralities = self._evaluate(sequence, best.evidence, np.where(in_reach, _score(best, in_reach), 0.0))
            if noncentralities is not None:
                best = noncentralities
        return best

    def _separation(
        self, pair: tuple[int, int], noncentralities: dict[tuple[int, int], float], times: float, values: int
    ) -> Separation:
        """Separation of a pair if the one that is harder to confirm is true, with the evidence times a factor."""
        one, two = (self._alternatives.members[index] for index in pair)
        more = (two.n_parameters - one.n_parameters) * (log(values) - 1.0)
        cases = []
        for evidence, price in ((noncentralities[pair], more), (noncentralities[pair[::-1]], -more)):
            expected = times * evidence + price
            cases.append((expected, decision_probability(expected, times * evidence)))
        return Separation((one.name, two.name), *min(cases))

    def _levels(self, sequence: InputSequence, times: int) -> Array:
        """Levels of repeated patterns."""
        return np.tile(sequence.levels(self._ends, PATTERN_ROWS), times)

    def _list_labels(self, names: Iterable[str]) -> str:
        labels = {alternative.name: alternative.label for alternative in self._alternatives.members}
        return _list_names([labels[name] for name in names])


def _list_names(names: Sequence[str], word: str = "and") -> str:
    """Names in words.

    >>> _list_names(["q", "P", "u"], "or")
    'q, P or u'
    """
    return f" {word} ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _describe_limits(alternatives: Predictions, model: ProcessModel) -> str:
    parts = [f"{name} {_range(alternatives.limits[name])} {unit}" for name, unit in model.units.items()]
    return f"the limits ({', '.join(parts)})"


def _score(item: _Trial, in_reach: Array) -> float:
    """Evidence of the pair that is separated least, among those in reach."""
    return float(np.min(item.evidence[in_reach]))


def _range(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}"


def _percent(share: float) -> str:
    return "over 99" if share > 0.99 else f"{100.0 * share:.0f}"
