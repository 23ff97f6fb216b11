"""Health message of a plant's monitor."""

from collections.abc import Mapping

from monitor_node.ingest.alignment import Counts
from reactorwatch import __version__
from reactorwatch.contract.messages_pb2 import Health

NODE = "monitor"


def health_message(
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
    """Health message of a plant's monitor.

    Args:
        now_ns: present time.
        phase: as `Monitor.phase`, or `stopped`.
        start_ns: start of the monitor.
        counts: counts of samples and rows.
        refused: number of rejected messages by reason.
        received: number of messages received.
        published: number of messages published.
        lag_ns: longest delay of a message.
        heard_from_ns: time of the first sample by signal.
        not_stored: number of failures to store the state.
        stalls: number of ticks that were more than a second late.
        failures: number of contained errors of this software by stage.
        reference: kind of the reference; empty before there is one.
        training: share of the training that is done.
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
