"""Inspect a recording: a file in any state, or the files in a folder."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from reactorwatch.contract import keys
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.storage.gaps import GAP, from_metadata
from recorder.storage.mcap_chunks import metadata_records
from recorder.storage.mcap_scan import Scan
from recorder.storage.mcap_types import Metadata
from recorder.storage.mcap_writer import own_metadata
from recorder.storage.process_metadata import processes_in
from recorder.tools.mcap_file import read_messages, read_metadata, recordings_in, zero_from
from recorder.tools.overview import Overview, overview


@dataclass(frozen=True)
class FileInfo:
    """Content and condition of a recording.

    Attributes:
        overview: summary of the messages.
        metadata: metadata of the file, or of the first file of a folder.
        zero_ns: time that minutes count from.
        damages: unreadable parts; empty if the file is intact.
        gaps: messages lost on the bus before the recorder.
        processes: processes by plant, as the recording describes them.
    """

    overview: Overview
    metadata: dict[str, str]
    zero_ns: int
    damages: tuple[str, ...]
    gaps: tuple[Gap, ...] = ()
    processes: Mapping[str, Process] = field(default_factory=dict)


def inspect(path: Path) -> FileInfo:
    """Inspect a recording; a single file may be damaged or still being written.

    Raises:
        InputError: it is no recording, or a file of the folder is damaged.
    """
    damages: list[str] = []
    if path.is_dir():
        found, metadata = overview(read_messages(path)), read_metadata(path)
        records = [record for file in recordings_in(path) for record in metadata_records(file)]
    else:
        scan = Scan(path)
        found = overview(stored.recorded_message for stored in scan)
        records, metadata = scan.metadata, own_metadata(scan.metadata)
        damages += map(str, scan.damages)
        if scan.orphans:
            damages.append(f"{scan.orphans} messages of channels that are described nowhere")
    zero_ns = zero_from(metadata, found.starts_ns or 0)
    return FileInfo(found, metadata, zero_ns, tuple(damages), _gaps(records), processes_in(records))


def gaps_in(path: Path) -> tuple[Gap, ...]:
    """Messages lost on the bus before the recorder, from the metadata of a file or a folder.

    Raises:
        InputError: a file is damaged.
    """
    return _gaps(record for file in recordings_in(path) for record in metadata_records(file))


def zero_ns_of(path: Path) -> int:
    """Time that minutes of a recording count from: its metadata, else the first sample of its first run.

    Raises:
        InputError: it holds no sample, or it is damaged.
    """
    starts_ns = overview(read_messages(path, {keys.SAMPLE})).starts_ns
    if starts_ns is None:
        raise InputError(f"{path}: holds no sample")
    return zero_from(read_metadata(path), starts_ns)


def _gaps(records: Iterable[Metadata]) -> tuple[Gap, ...]:
    found = (from_metadata(record.metadata) for record in records if record.name == GAP)
    return tuple(gap for gap in found if gap is not None)
