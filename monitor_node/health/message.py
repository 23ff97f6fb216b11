"""Health message of a plant's monitor."""

from collections.abc import Mapping

from monitor_node.ingest.alignment import Counts
from monitor_node.ingest.receive_stats import ReceiveStats
from reactorwatch import __version__
from reactorwatch.contract.messages_pb2 import Health

NODE = "monitor"


def complete_health(
    health: Health, now_ns: int, stats: ReceiveStats, samples: Counts, refused: Mapping[str, int]
) -> None:
    """Fill the fields of a health message that statistics and counts give.

    Args:
        health: message with the other fields.
        now_ns: present time.
        stats: statistics by receive time.
        samples: counts of samples and rows since the monitor was made, or since its state was.
        refused: number of rejected messages by reason.
    """
    counted = Health(
        time_ns=now_ns,
        node=NODE,
        version=__version__,
        uptime_s=(now_ns - stats.start_ns) / 1e9,
        lost=samples.lost,
        late=samples.late,
        refused=sum(refused.values()),
        refused_by_reason=refused,
        lag_ms=stats.lag_ns / 1e6,
        duplicated=samples.duplicated,
        out_of_order=samples.out_of_order,
        rows=samples.rows,
        incomplete_rows=samples.incomplete_rows,
        not_stored=stats.not_stored,
        stalls=stats.stalls,
    )
    health.MergeFrom(counted)
