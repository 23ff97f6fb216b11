"""Time and memory of a dashboard of a million samples. Goal: 10 s and 500 MB.

Drawn are a recording of samples alone, one four times as long, which must not take more memory, and one with the
messages of a monitor beside its samples. Each is drawn in a process of its own, whose peak memory is printed; the time
is also printed as a multiple of that of the bare MCAP library reading the same file without decoding anything, because
machines differ in speed.

    python benchmarks/dashboard.py
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from mcap.reader import make_reader

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Publication, encode
from reactorwatch.process.library.cstr import cstr
from recorder import RecordedMessage
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter

UNITS = cstr().units

SAMPLES = 1_000_000
HOUR = 600  # rows
STEP_NS = 6_000_000_000


def run(samples: int, *, watched: bool) -> Iterator[Publication]:
    """A plant's hour again and again until there are so many samples; with what a monitor says of them, if watched."""
    hour = simulate_record(PlantConfig(seed=1), HOUR).columns
    for row in range(samples // len(UNITS)):
        at = row * STEP_NS
        for signal, unit in UNITS.items():
            value = float(hour[signal][row % HOUR])
            good = messages.QUALITY_GOOD
            yield _of(
                keys.SAMPLE, signal, messages.Sample(time_ns=at, sequence=row, value=value, unit=unit, quality=good)
            )
        if not watched:
            continue
        for signal in ("C", "T"):
            value = float(hour[signal][row % HOUR])
            estimate = messages.Estimate(
                time_ns=at,
                prediction=value,
                residual=0.1,
                lower_limit=value - 1.0,
                upper_limit=value + 1.0,
                unit=UNITS[signal],
            )
            yield _of(keys.ESTIMATE, signal, estimate)
        for chart in ("shewhart/C", "shewhart/T", "ewma/C", "ewma/T", "mewma/all"):
            point = messages.ChartPoint(time_ns=at, statistic=row % 7, centre=3.0, lower_limit=-3.0, upper_limit=9.0)
            yield _of(keys.CHART, chart, point)


def _of(kind: str, name: str, message: Body) -> Publication:
    return Publication(keys.key("cstr", kind, name), message)


def record(path: Path, publications: Iterator[Publication]) -> int:
    """Write them into a recording; returns how many."""
    number = 0
    with RecordingWriter(path, {}) as writer:
        for number, publication in enumerate(publications, start=1):
            key, payload, encoding, _ = encode(publication)
            writer.write(RecordedMessage(key, payload, encoding, number * 1000, publication.message.time_ns))
    return number


def read_bare(path: Path) -> None:
    """The library alone, in file order."""
    with path.open("rb") as stream:
        for _ in make_reader(stream).iter_messages(log_time_order=False):
            pass


def draw(path: Path) -> None:
    """Draw a recording as `dashboard` does."""
    from recorder.columns import read_segments
    from recorder.view.file import write_rrd

    write_rrd(read_segments(Recording(path).messages()), path.with_suffix(".rrd"))


TASKS = {"bare": read_bare, "draw": draw}


def measure(task: str, path: Path) -> tuple[float, float]:
    """Seconds and megabytes of a task in a process of its own, its start included."""
    start = time.perf_counter()
    command = [sys.executable, __file__, task, str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return time.perf_counter() - start, float(done.stdout)


def main() -> None:
    """Print the table."""
    if len(sys.argv) == 3:
        TASKS[sys.argv[1]](Path(sys.argv[2]))
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        return
    print("                                seconds     MB   over bare MCAP   MB of .mcap  of .rrd")
    with tempfile.TemporaryDirectory() as name:
        for title, samples, watched in (
            ("a million samples", SAMPLES, False),
            ("four million samples", 4 * SAMPLES, False),
            ("a million samples, watched", SAMPLES, True),
        ):
            path = Path(name) / f"{title}.mcap"
            count = record(path, run(samples, watched=watched))
            (bare_s, _), (seconds, peak_mb) = (measure(task, path) for task in ("bare", "draw"))
            sizes = [file.stat().st_size / 1e6 for file in (path, path.with_suffix(".rrd"))]
            print(
                f"{title:30s} {seconds:8.1f} {peak_mb:6.0f} {seconds / bare_s:16.2f} {sizes[0]:13.0f} {sizes[1]:8.0f}"
                f"   ({count:,} messages)",
                flush=True,
            )


if __name__ == "__main__":
    main()
