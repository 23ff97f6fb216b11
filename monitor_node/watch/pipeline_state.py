"""State of a plant's pipeline, composed of its parts' states."""

import msgspec

from monitor_node.causes.stage import SuspicionMemory
from monitor_node.charts.charts import ChartsMemory
from monitor_node.ingest.sampling import SamplingPeriod
from monitor_node.learn.arx_reference import ArxMemory
from monitor_node.learn.black_box_reference import BlackBoxMemory
from monitor_node.learn.process_reference import ProcessMemory
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.operation import CarriedState
from monitor_node.watch.promise import PlantPromise
from reactorwatch.stored_state import StoredState


class TrainedState(StoredState, frozen=True):
    """State after the training.

    Attributes:
        reference: memory of the reference; None: the identified models judge.
        checks: checks of the training: name and result of each.
        left_out: signals that are not monitored, with the reason.
        whiteners: numbers of the prewhitening filters, one an output, see `WHITENER`.
        charts: memory of the charts.
        suspicion: memory of the search for causes; None if there is none.
        arl0: in-control run length of each alarm, in rows.
        withheld: one flag an output: its newest value is quarantined as a possible spike.
        rows_watched: number of evaluated rows.
        until_drift: number of rows until the next drift point.
        baseline: change of the model in force, a serialized `Baseline`; empty: the model is as given.
        shift: numbers of the tests for lasting steps, one an output, see `STEP_TEST`; empty without them.
        promise: the promise of false alarms.
    """

    reference: ProcessMemory | BlackBoxMemory | None
    checks: list[tuple[str, str]]
    left_out: dict[str, str]
    whiteners: bytes
    charts: ChartsMemory
    suspicion: SuspicionMemory | None
    arl0: float
    withheld: list[bool]
    rows_watched: int
    until_drift: int
    baseline: bytes = b""
    shift: bytes = b""
    promise: PlantPromise | None = None


class KeptBaseline(StoredState, frozen=True):
    """A baseline that was replaced, and can be restored.

    Attributes:
        change: change by which it came into force, a serialized `Baseline`.
        trained: state after the training, when it was replaced.
        models: memory of the identified models.
        signals: memory of each signal check.
    """

    change: bytes
    trained: TrainedState
    models: ArxMemory
    signals: dict[str, bytes]


class ModeTraining(StoredState, frozen=True):
    """Training in a mode that was left before its end.

    Attributes:
        rows: rows of the training.
        models: memory of the identified models.
    """

    rows: TrainingRows
    models: ArxMemory


class ModesState(msgspec.Struct, forbid_unknown_fields=True):
    """State of the modes of a plant.

    Attributes:
        mode: present mode, one value a signal; NaN before its first sample.
        is_judged: False in a mode in which signals are checked only.
        is_learned: True once a mode was learned: one that is new then has not been seen in the training.
        reference: kind of the reference that judged last.
        expected: false alarms expected in the modes before, less those of the present one before.
        is_resumed: True if the present mode was seen in the training, and is learned from these rows now.
        baselines: baselines of the other modes.
        trainings: trainings of the other modes.
    """

    mode: list[float]
    is_judged: bool = True
    is_learned: bool = False
    reference: str = ""
    expected: float = 0.0
    is_resumed: bool = False
    baselines: dict[str, KeptBaseline] = msgspec.field(default_factory=dict)
    trainings: dict[str, ModeTraining] = msgspec.field(default_factory=dict)


class PipelineState(StoredState, frozen=True):
    """State of a pipeline, without the alarms.

    Attributes:
        sampling: state of the sampling period.
        signals: memory of each signal check.
        models: memory of the identified models.
        refusals: number of refused trainings.
        began_ns: start of the present or last training; None before its first row.
        training: rows of the training; after it while its diagnosis is pending, then empty.
        watched: state after the training; None before its end.
        operation: states of modes and set points, by signal.
        kept: baselines that can be restored, the oldest first.
        change: newest change of the baseline by a command, while the plant is trained because of it; empty else.
        incident: rows since an alarm without a known cause is active; None: there is none.
        modes: state of the plant's modes; None without signals of modes.
        commands: changes by accepted commands that hold from the next row on, each a serialized `Baseline`, in order.
    """

    sampling: SamplingPeriod
    signals: dict[str, bytes]
    models: ArxMemory
    refusals: int
    began_ns: int | None
    training: TrainingRows
    watched: TrainedState | None
    operation: dict[str, CarriedState] = msgspec.field(default_factory=dict)
    kept: list[KeptBaseline] = msgspec.field(default_factory=list)
    change: bytes = b""
    incident: TrainingRows | None = None
    modes: ModesState | None = None
    commands: list[bytes] = msgspec.field(default_factory=list)
