"""Health message of a plant's monitor."""

from collections.abc import Mapping
from typing import NamedTuple

from monitor_node.ingest.alignment import Counts
from monitor_node.ingest.receive_stats import ReceiveStats
from reactorwatch import __version__
from reactorwatch.contract.messages_pb2 import Health

NODE = "monitor"


class Processed(NamedTuple):
    """Counts of what a monitor has processed.

    Attributes:
        samples: counts of samples and rows.
        received: number of messages received.
        published: number of messages published.
        refused: number of rejected messages by reason.
        failures: number of contained errors of this software by stage.
        heard_from_ns: time of the first sample by signal.
    """

    samples: Counts
    received: int
    published: int
    refused: Mapping[str, int]
    failures: Mapping[str, int]
    heard_from_ns: Mapping[str, int]


def health_message(
    now_ns: int, phase: str, processed: Processed, stats: ReceiveStats, *, reference: str, training: float
) -> Health:
    """Health message of a plant's monitor.

    Args:
        now_ns: present time.
        phase: as `Monitor.phase`, or `stopped`.
        processed: counts since the monitor was made, or since its state was.
        stats: statistics by receive time.
        reference: kind of the reference; empty before there is one.
        training: share of the training that is done.
    """
    samples = processed.samples
    return Health(
        time_ns=now_ns,
        node=NODE,
        version=__version__,
        phase=phase,
        uptime_s=(now_ns - stats.start_ns) / 1e9,
        received=processed.received,
        lost=samples.lost,
        late=samples.late,
        refused=sum(processed.refused.values()),
        refused_by_reason=processed.refused,
        lag_ms=stats.lag_ns / 1e6,
        duplicated=samples.duplicated,
        out_of_order=samples.out_of_order,
        published=processed.published,
        rows=samples.rows,
        incomplete_rows=samples.incomplete_rows,
        heard_from_ns=processed.heard_from_ns,
        not_stored=stats.not_stored,
        stalls=stats.stalls,
        failures=processed.failures,
        reference=reference,
        training=training,
    )
