"""What the watch over a plant remembers, put together from what its parts do."""

from monitor_node.baseline.predictor import PredictorState
from monitor_node.baseline.references import ArxReferenceState, ProcessReferenceState
from monitor_node.baseline.training import TrainingState
from monitor_node.chart_stage import ChartsState
from monitor_node.ingest.sampling import SamplingState
from monitor_node.isolation.stage import SuspicionState
from monitor_node.signal_checks.stage import SignalsState
from reactorwatch.spc.prewhitening import PrewhitenerState
from reactorwatch.stored_state import StoredState


class WatchedState(StoredState, frozen=True):
    """What a training came to, and what is remembered since.

    Attributes:
        reference: that rows are expected by.
        checks: what was said of the training: name and result of each.
        left_out: signals that are not watched, each with the reason.
        whiteners: one an output.
        charts: all of them.
        suspicion: None: causes are not looked for.
        arl0: run length of each alarm without a fault, in rows.
        withheld: outputs whose newest value may be an outlier.
        rows_watched: rows that were judged.
        until_drift: rows until the next look at the drift.
    """

    reference: ProcessReferenceState | ArxReferenceState
    checks: list[tuple[str, str]]
    left_out: dict[str, str]
    whiteners: list[PrewhitenerState]
    charts: ChartsState
    suspicion: SuspicionState | None
    arl0: float
    withheld: list[bool]
    rows_watched: int
    until_drift: int


class WatchState(StoredState, frozen=True):
    """All that the watch over a plant remembers, but for its alarms.

    Attributes:
        sampling: how rows come.
        signals: silence, stuck sensors and spikes.
        predictors: one an output.
        refusals: how many trainings were refused.
        began_ns: when the present training, or the last, began; None before its first row.
        training: its rows; none when it is over.
        watched: None while it is not.
    """

    sampling: SamplingState
    signals: SignalsState
    predictors: list[PredictorState]
    refusals: int
    began_ns: int | None
    training: TrainingState
    watched: WatchedState | None
