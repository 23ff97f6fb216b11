"""How a plant's monitor does, as it tells."""

from collections.abc import Mapping

from monitor_node.ingest.alignment import Counts
from reactorwatch import __version__
from reactorwatch.contract.messages_pb2 import Health

NODE = "monitor"


def health_of(
    now_ns: int,
    phase: str,
    start_ns: int,
    counts: Counts,
    refused: Mapping[str, int],
    *,
    received: int,
    published: int,
    lag_ns: int,
    heard_from_ns: Mapping[str, int],
    not_stored: int,
    stalls: int,
    failures: Mapping[str, int],
    reference: str,
    training: float,
) -> Health:
    """How a plant's monitor does.

    Args:
        now_ns: the time.
        phase: as `Monitor.phase`, or `stopped`.
        start_ns: when it was started.
        counts: of samples on their way into rows.
        refused: counts by reason.
        received: messages so far.
        published: likewise.
        lag_ns: the longest that one has waited.
        heard_from_ns: by signal, the time of its first sample.
        not_stored: how often what is remembered could not be stored.
        stalls: how often the clock was looked at more than a second late.
        failures: number of contained errors of this software, by stage.
        reference: what rows are judged by; empty before they are.
        training: the share of the training that is done.
    """
    return Health(
        time_ns=now_ns,
        node=NODE,
        version=__version__,
        phase=phase,
        uptime_s=(now_ns - start_ns) / 1e9,
        received=received,
        lost=counts.lost,
        late=counts.late,
        refused=sum(refused.values()),
        refused_by_reason=refused,
        lag_ms=lag_ns / 1e6,
        duplicated=counts.duplicated,
        out_of_order=counts.out_of_order,
        published=published,
        rows=counts.rows,
        incomplete_rows=counts.incomplete_rows,
        heard_from_ns=heard_from_ns,
        not_stored=not_stored,
        stalls=stalls,
        failures=failures,
        reference=reference,
        training=training,
    )
