"""Samples added in batches give the same series as samples added one by one."""

from hypothesis import example, given
from hypothesis import strategies as st

from reactorwatch.contract import messages_pb2 as messages
from recorder.columns.run_splitter import RunSplitter
from recorder.columns.sample_series import SampleSeries

PERIOD = 6_000_000_000
SIGNALS = ("qc", "C", "T")
EVENTS = (
    "usual", "restart", "clock back", "stray", "gap", "duplicate", "late", "lone", "unit", "no unit",
    "bad", "no quality", "not finite", "large", "undecodable", "not canonical", "uncounted",
)  # fmt: skip


def payloads(rows: list[tuple[str, int]]) -> list[tuple[str, bytes]]:
    """Signals and bytes of rows; each has an event, and a number that says by how much or at which signal."""
    found: list[tuple[str, bytes]] = []
    time_ns, number, unit = 100 * PERIOD, 0, "K"
    for event, amount in rows:
        if event in ("restart", "uncounted"):
            number = 0
        if event == "clock back":
            time_ns -= amount * PERIOD
        if event == "gap":
            number, time_ns = number + amount, time_ns + amount * PERIOD
        if event in ("unit", "no unit"):
            unit = f"K{amount % 3}" if event == "unit" else ""
        row: list[tuple[str, bytes]] = []
        for index, signal in enumerate(SIGNALS):
            sample = messages.Sample(
                time_ns=time_ns, sequence=number, value=amount + index, unit=unit, quality=messages.QUALITY_GOOD
            )
            payload = b""
            if index == amount % len(SIGNALS):
                if event == "stray":
                    sample.sequence, sample.time_ns = number + 1000 * amount, time_ns + 7
                elif event == "bad":
                    sample.quality = messages.QUALITY_BAD
                elif event == "no quality":
                    sample.quality = messages.QUALITY_UNSPECIFIED
                elif event == "not finite":
                    sample.value = (float("nan"), float("inf"), -float("inf"))[amount % 2]
                elif event == "large":
                    sample.value = -1e300
                elif event == "undecodable":
                    payload = b"\xff"
                elif event == "not canonical":  # fields twice: the last one counts
                    payload = messages.Sample(value=amount).SerializeToString() + sample.SerializeToString()
            row.append((signal, payload or sample.SerializeToString()))
        if event == "lone":
            del row[amount % len(SIGNALS)]
        if event == "duplicate":
            row += row
        found += row
        if event == "late" and len(found) > 2 * len(row):
            found[-len(row) :], found[-2 * len(row) : -len(row)] = (
                found[-2 * len(row) : -len(row)],
                found[-len(row) :],
            )
        number, time_ns = number + 1, time_ns + PERIOD
    return found


def content(series: SampleSeries) -> tuple[object, ...]:
    runs = [
        {name: (list(times), list(map(str, values))) for name, (times, values) in run.items()} for run in series.runs
    ]
    counters = {name: repr(counter) for name, counter in series.splitter.counters.items()}
    return runs, series.units, counters, splitter_state(series.splitter)


def splitter_state(splitter: RunSplitter) -> tuple[object, ...]:
    return splitter.runs, splitter.current, splitter.strays


ROWS = st.lists(st.tuples(st.one_of(st.just("usual"), st.sampled_from(EVENTS)), st.integers(1, 60)), max_size=40)


@given(ROWS, st.integers(1, 40))
@example([(event, 5) for item in EVENTS for event in ("usual", "usual", "usual", "usual", item)], 6)
def test_batches_give_the_series_of_single_samples(rows: list[tuple[str, int]], batch: int) -> None:
    sent, one_by_one, batched = payloads(rows), SampleSeries(), SampleSeries()
    for signal, payload in sent:
        one_by_one._add_sample(signal, payload)
    for start in range(0, len(sent), batch):
        part = sent[start : start + batch]
        batched.add([signal for signal, _ in part], [payload for _, payload in part])
    assert content(batched) == content(one_by_one)


def test_single_samples_give_the_runs_of_the_splitter() -> None:
    rows = [("usual", 1)] * 5 + [("restart", 1)] + [("usual", 1)] * 5
    series, splitter = SampleSeries(), RunSplitter()
    for signal, payload in payloads(rows):
        series._add_sample(signal, payload)
        sample = messages.Sample.FromString(payload)
        splitter.update(signal, sample.sequence, sample.time_ns)
    assert splitter_state(series.splitter) == splitter_state(splitter)
    assert [len(times) for run in series.runs for times, _ in run.values()] == [5, 5, 5, 6, 6, 6]


def test_usual_samples_are_not_decoded_one_by_one() -> None:
    sent, series = payloads([("usual", 1)] * 40), SampleSeries()
    series.add(*map(list, zip(*sent[:6], strict=True)))
    single: list[str] = []
    series._add_sample = lambda signal, payload: single.append(signal)  # type: ignore[method-assign]
    series.add(*map(list, zip(*sent[6:], strict=True)))
    assert single == []
    assert [len(times) for times, _ in series.runs[0].values()] == [40, 40, 40]
