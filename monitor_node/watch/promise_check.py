"""A training, judged by itself: learned on its first half, and the second half watched with what was learned. Pure.

Twice: with limits for the promised rate, at which a few hundred rows hardly ever have an alarm, and with limits at
which some are expected. Many more than those show that residuals are larger than the training said; how often the
tighter limits are then crossed follows from both (`excess_by_events`). The uncertainty of limits from half the rows is
allowed for.

Where the events are those of some charts, and the others have no more than chance explains, these charts break the
promise: they are left out, and the others have their share of the false alarms.
"""

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import LARGEST_FALSE_ALARMS, MonitorConfig
from monitor_node.ingest.alignment import Row
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.pipeline import PlantPipeline
from monitor_node.watch.promise import (
    EVENT_ROWS,
    RAISED,
    UNLIKELY,
    PlantPromise,
    TrainingCheck,
    excess_by_events,
    probability_of,
)
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.charts.level import Level
from reactorwatch.stored_state import copy_of


class _Trial(NamedTuple):
    """Second half of a training, as watched.

    Attributes:
        promise: the promise, with the alarms that came.
        rows: number of rows judged.
        rates: false alarms a row by the errors that the first half may have made, shape (draws,).
        alarms: number of alarms that chance can raise.
        quiet_rows: number of rows without an active alarm: while one is, no other event comes.
        shares: share of each chart in these alarms, by name.
        raised: row and chart, or check, of each alarm.
    """

    promise: PlantPromise
    rows: int
    rates: Array
    alarms: int
    quiet_rows: int
    shares: dict[str, float]
    raised: list[tuple[int, str]]

    @property
    def mean_count(self) -> float:
        """Number of alarms promised, on average."""
        return self.promise.mean_count(self.rows)

    @property
    def is_unlikely(self) -> bool:
        """True if chance hardly explains so many alarms."""
        return probability_of(self.promise.events, self.rates * self.rows) < UNLIKELY

    @property
    def excessive(self) -> set[str]:
        """Charts of whose events chance hardly explains so many."""
        return {name for name, share in self.shares.items() if not self._holds({name}, share)}

    def holds_without(self, charts: Collection[str]) -> bool:
        """True if chance explains the events without these charts."""
        others = {name for _, name in self.raised} - set(charts)
        return self._holds(others, 1.0 - sum(self.shares[name] for name in charts))

    def _holds(self, names: Collection[str], share: float) -> bool:
        """True if chance explains the separate events of some charts and checks, given their share in the alarms."""
        rows = [row for row, name in self.raised if name in names]
        events = len(rows) and 1 + sum(row - before > EVENT_ROWS for before, row in pairwise(rows))
        return probability_of(events, self.rates * self.rows * share) >= UNLIKELY

    @property
    def arl0(self) -> float:
        """Run length of each alarm, in rows."""
        return self.rows * self.alarms / self.mean_count


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

        def start(config: MonitorConfig) -> tuple[PlantPipeline, Annunciator]:
            """A pipeline that starts with what was learned; its settings may differ in the false alarms."""
            board = Annunciator(config)
            pipeline = PlantPipeline(config, board, points=False, model=model)
            pipeline.resume(copy_of(memory), 0)
            reference = learned.reference(pipeline.baselines.equations, config.outputs, pipeline.models)
            pipeline.start(trained._replace(reference=reference, checks=list(trained.checks)))
            return pipeline, board

        strict = _watch(*start(settings), aligned[half:], units)
        # so that some alarms are expected with the wider limits
        per_30_days = min(strict.promise.per_30_days * 3.0 / strict.mean_count, LARGEST_FALSE_ALARMS)
        wide = msgspec.structs.replace(settings, false_alarms_per_30_days=per_30_days)
        trials = (strict, _watch(*start(wide), aligned[half:], units))
    except InputError:  # too few rows, no output that can be watched after half of them, or limits that no chart has
        return TrainingCheck()
    excess, unlikely = 0.0, [trial for trial in trials if trial.is_unlikely]
    excessive = [name for name in strict.shares if any(name in trial.excessive for trial in unlikely)]
    seen_by_others = {*strict.shares} - {*excessive, Level.name}  # a chart of levels sees slow changes only
    if not (seen_by_others and all(trial.holds_without(excessive) for trial in trials)):
        excessive = []
    if unlikely and not excessive:
        counts = [(trial.promise.events, trial.arl0, float(trial.quiet_rows * trial.alarms)) for trial in trials]
        share = strict.quiet_rows / max(strict.rows, 1)  # events come in the rows without an alarm only
        excess = max(share * excess_by_events(*zip(*counts, strict=True)), 1.5)
    found = strict.promise.found - sum(name in excessive for _, name in strict.raised)
    return TrainingCheck(strict.rows, found, strict.mean_count, excess, tuple(excessive))


def _watch(pipeline: PlantPipeline, board: Annunciator, rows: Sequence[Row], units: list[str]) -> _Trial:
    """Watch rows with a trained pipeline."""
    promise = pipeline.evaluation.promises.promise
    assert promise is not None
    evaluation, raised, quiet_rows = pipeline.evaluation, list[tuple[int, str]](), 0
    for index, row in enumerate(rows):
        published: list[Publication] = []
        quiet_rows += not board.has_unexplained
        pipeline.update(row, units, published)
        alarms = [item.message for item in published if isinstance(item.message, Alarm)]
        raised += [(index, alarm.alarm.partition("/")[0]) for alarm in alarms if alarm.event == RAISED]
    watched, count = evaluation.memory.rows_watched, evaluation.chance_alarms
    shares = {name: number / count for name, number in evaluation.charts.design.alarms_of_each.items()}
    return _Trial(promise, watched, evaluation.promises.alarm_rates, count, quiet_rows, shares, raised)
