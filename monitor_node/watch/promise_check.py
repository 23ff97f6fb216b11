"""A training, judged by itself: learned on its first half, and the second half watched with what was learned. Pure.

Twice: with limits for the promised rate, at which a few hundred rows hardly ever have an alarm, and with limits at
which some are expected. Many more than those show that residuals are larger than the training said; how often the
tighter limits are then crossed follows (`extrapolate_count`). The uncertainty of limits from half the rows is allowed
for.
"""

from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import LARGEST_FALSE_ALARMS, MonitorConfig
from monitor_node.ingest.alignment import Row
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.pipeline import PlantPipeline
from monitor_node.watch.promise import (
    UNLIKELY,
    PlantPromise,
    TrainingCheck,
    extrapolate_count,
    probability_of,
)
from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import copy_of


class _Trial(NamedTuple):
    """Second half of a training, as watched.

    Attributes:
        promise: the promise, with the alarms that came.
        rows: number of rows judged.
        rates: false alarms a row by the errors that the first half may have made, shape (draws,).
        opportunities: rows times alarms that chance can raise.
    """

    promise: PlantPromise
    rows: int
    rates: Array
    opportunities: float

    @property
    def mean_count(self) -> float:
        """Number of alarms promised, on average."""
        return self.promise.mean_count(self.rows)

    @property
    def is_unlikely(self) -> bool:
        """True if chance hardly explains so many alarms."""
        return probability_of(self.promise.events, self.rates * self.rows) < UNLIKELY

    def count_at(self, arl0: float) -> float:
        """Number of alarms with limits for a run length."""
        found, own_arl0 = self.promise.found, self.opportunities / self.mean_count
        return extrapolate_count(found, own_arl0, self.opportunities, arl0)


def check_training(
    config: MonitorConfig, model: ProcessModel | None, rows: TrainingRows, reference: str
) -> TrainingCheck:
    """Judge the second half of a training by the first; one that is too short is not judged."""
    aligned = [Row(time_ns, tuple(values), False) for time_ns, values in zip(rows.times_ns, rows.values(), strict=True)]
    half = len(aligned) // 2
    settings = msgspec.structs.replace(config, reference=reference, isolation=False, diagnose_training=False)
    learner = PlantPipeline(settings, Annunciator(settings), points=False, model=model)
    learner.training.open()
    units = [""] * len(config.outputs)
    for row in aligned[:half]:
        learner.update(row, units, [])
    try:
        trained = learner.training.finish_early(times=2)  # with fewer rows it is too rough to judge the rest
        memory, learned = copy_of(learner.memory), copy_of(trained.reference.memory)

        def start(config: MonitorConfig) -> PlantPipeline:
            """A pipeline that starts with what was learned; its settings may differ in the false alarms."""
            pipeline = PlantPipeline(config, Annunciator(config), points=False, model=model)
            pipeline.resume(copy_of(memory), 0)
            reference = learned.reference(pipeline.baselines.equations, config.outputs, pipeline.models)
            pipeline.start(trained._replace(reference=reference, checks=list(trained.checks)))
            return pipeline

        strict = _watch(start(settings), aligned[half:], units)
        # so that some alarms are expected with the wider limits
        per_30_days = min(strict.promise.per_30_days * 3.0 / strict.mean_count, LARGEST_FALSE_ALARMS)
        wide = msgspec.structs.replace(settings, false_alarms_per_30_days=per_30_days)
        trials = (strict, _watch(start(wide), aligned[half:], units))
    except InputError:  # too few rows, no output that can be watched after half of them, or limits that no chart has
        return TrainingCheck()
    counts = [trial.count_at(strict.opportunities / strict.mean_count) for trial in trials if trial.is_unlikely]
    return TrainingCheck(
        strict.rows, strict.promise.found, strict.mean_count, max(counts, default=0.0) / strict.mean_count
    )


def _watch(pipeline: PlantPipeline, rows: Sequence[Row], units: list[str]) -> _Trial:
    """Watch rows with a trained pipeline."""
    promise = pipeline.evaluation.promises.promise
    assert promise is not None
    for row in rows:
        pipeline.update(row, units, [])
    evaluation = pipeline.evaluation
    opportunities = float(evaluation.memory.rows_watched * evaluation.chance_alarms)
    return _Trial(promise, evaluation.memory.rows_watched, evaluation.promises.alarm_rates, opportunities)
