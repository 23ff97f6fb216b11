"""Memory of a plant's pipeline, composed of its parts' memories: what runs, and what is stored."""

from typing import Any

import msgspec

from monitor_node.causes.stage import SuspicionMemory
from monitor_node.charts.charts import ChartsMemory
from monitor_node.ingest.rows import SamplingPeriod
from monitor_node.learn.arx import ArxMemory, ArxPredictor
from monitor_node.learn.black_box_reference import BlackBoxMemory
from monitor_node.learn.process_reference import ProcessMemory
from monitor_node.learn.training import TrainingMemory
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.operation import CarriedState
from monitor_node.watch.promise import PlantPromise
from reactorwatch.contract.messages_pb2 import Baseline, Check
from reactorwatch.stored_state import Memory, Records


class EvaluationMemory(Memory, kw_only=True):
    """Memory of what judges the rows: in force, of an earlier baseline that can be restored, or of another mode.

    Attributes:
        predictors: identified models, one an output.
        signals: memory of each signal check by name; as it was read, until the checks go on from it.
        whiteners: prewhitening filters, one an output, see `WHITENER`.
        quarantined: one flag an output: its newest value may be a spike.
        reference: memory of the reference; None before the end of the training.
        checks: checks of the training.
        left_out: signals that are not monitored, with the reason.
        charts: memory of the charts.
        shift: tests for lasting steps, one an output, see `STEP_TEST`; None without them.
        suspicion: memory of the search for causes; None if there is none.
        promise: the promise of false alarms.
        arl0: in-control run length of each alarm, in rows; 0 before the end of the training.
        rows_watched: number of evaluated rows.
        until_drift: number of rows until the next drift point.
        incident: rows since an alarm without a known cause is active; None: there is none.
        change: change of the baseline by which it came into force; None: the first training.
        training: rows of its training, of a mode that was left before the end; None else.
    """

    predictors: list[ArxPredictor]
    signals: dict[str, Any]
    whiteners: Records
    quarantined: tuple[bool, ...]
    reference: ProcessMemory | BlackBoxMemory | ArxMemory | None = None
    checks: list[Check] = msgspec.field(default_factory=list)
    left_out: dict[str, str] = msgspec.field(default_factory=dict)
    charts: ChartsMemory = msgspec.field(default_factory=ChartsMemory)
    shift: Records | None = None
    suspicion: SuspicionMemory | None = None
    promise: PlantPromise | None = None
    arl0: float = 0.0
    rows_watched: int = 0
    until_drift: int = 0
    incident: TrainingRows | None = None
    change: Baseline | None = None
    training: TrainingRows | None = None


class ModesMemory(Memory):
    """Memory of the modes of a plant; one without signals of modes is always in the same.

    Attributes:
        mode: present mode, one value a signal; NaN before its first sample.
        is_judged: False in a mode in which signals are checked only.
        is_learned: True once a mode was learned: one that is new then has not been seen in the training.
        reference: kind of the reference that judged last.
        expected: false alarms expected in the modes before, less those of the present one before.
        is_resumed: True if the present mode was seen in the training, and is learned from these rows now.
        others: memory of each other mode that was learned, or whose training was left before its end.
    """

    mode: list[float]
    is_judged: bool = True
    is_learned: bool = False
    reference: str = ""
    expected: float = 0.0
    is_resumed: bool = False
    others: dict[str, EvaluationMemory] = msgspec.field(default_factory=dict)


class PipelineMemory(Memory):
    """Memory of a pipeline, without the alarms.

    Attributes:
        sampling: sampling period.
        operation: modes and set points, by signal.
        training: memory of the training.
        evaluation: memory of what judges the rows.
        modes: memory of the modes.
        kept: baselines that can be restored, the oldest first.
        change: newest change of a baseline, of any mode; None: there was none.
        undiagnosed: rows of the training while its diagnosis is pending; None: it is not.
        commands: changes by accepted commands that hold from the next row on, in order.
    """

    sampling: SamplingPeriod
    operation: dict[str, CarriedState]
    training: TrainingMemory
    evaluation: EvaluationMemory
    modes: ModesMemory
    kept: list[EvaluationMemory]
    change: Baseline | None
    undiagnosed: TrainingRows | None
    commands: list[Baseline]
