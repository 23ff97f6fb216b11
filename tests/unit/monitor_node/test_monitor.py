"""The watch over a plant: it learns, it alarms when something is wrong, and nothing on the bus harms it."""

import math
from collections.abc import Iterable
from typing import Literal, TypeVar

import numpy as np
import pytest
from google.protobuf.message import Message

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import (
    Alarm,
    AlarmState,
    ChartPoint,
    Estimate,
    Health,
    ModelSnapshot,
    Quality,
    Sample,
)
from reactorwatch.records.record import to_time_ns

from .samples import PLANT, leaking_run, sample, samples

M = TypeVar("M", bound=Message)
CONFIG = MonitorConfig()
ONSET_MIN = 130.0


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    """A run of 160 min whose coolant leaks a tenth from minute 130 on."""
    return list(samples(*leaking_run(-0.1, ONSET_MIN, 160.0, seed=1)))


def watch(messages: Iterable[Encoded], config: MonitorConfig = CONFIG) -> tuple[Monitor, list[Publication]]:
    monitor = Monitor(config, 0)
    published = [publication for message in messages for publication in monitor.on_message(message, 0)]
    return monitor, published + monitor.finish()


@pytest.fixture(scope="module")
def published(leak: list[Encoded]) -> list[Publication]:
    """Publications of a monitor of that run."""
    return watch(leak)[1]


@pytest.fixture(scope="module")
def encoded(published: list[Publication]) -> list[Encoded]:
    """The same as bytes."""
    return [encode(item) for item in published]


def messages_of(published: list[Publication], kind: type[M]) -> list[M]:
    return [item.message for item in published if isinstance(item.message, kind)]


def health(monitor: Monitor) -> Health:
    (publication,) = monitor.on_tick(1)
    assert isinstance(publication.message, Health)
    return publication.message


def test_a_leak_raises_an_alarm_soon_after_it_and_none_before(published: list[Publication]) -> None:
    raised = [alarm for alarm in messages_of(published, Alarm) if alarm.state == AlarmState.ALARM_STATE_UNACKNOWLEDGED]
    assert raised
    assert "shewhart/T" in {alarm.alarm for alarm in raised}
    assert to_time_ns(ONSET_MIN) <= raised[0].time_ns <= to_time_ns(ONSET_MIN + 1)
    assert raised[0].raised_ns == raised[0].time_ns
    assert raised[0].text.startswith("T is ")


def test_a_sound_plant_raises_none_in_ten_runs() -> None:
    """One in 30 days lets 0.023 alarms be expected in the ten times 100 minutes."""
    config, expected = MonitorConfig(diagnose_training=False), 0.0
    for seed in range(10):
        result = backtest.run(samples(*leaking_run(0.0, 1.0, 200.0, seed)), config)
        assert result.alarm_messages == []
        expected += result.expected_false_alarms
    assert expected == pytest.approx(1000 / (30 * 24 * 60), rel=0.01)


def test_limits_are_in_standard_deviations_of_the_residual(published: list[Publication]) -> None:
    """Before the fault the charted residual has the variance one, and the estimate's limits are its own in kelvin."""
    sound = [
        point for item, point in ((item, item.message) for item in published)
        if isinstance(point, ChartPoint) and item.key.endswith("shewhart/T") and point.time_ns < to_time_ns(ONSET_MIN)
    ]  # fmt: skip
    assert np.std([point.statistic for point in sound]) == pytest.approx(1.0, rel=0.15)
    estimates = [
        item.message for item in published if isinstance(item.message, Estimate) and item.key.endswith("estimate/T")
    ]
    by_time = {estimate.time_ns: estimate for estimate in estimates}
    for point in sound:
        estimate = by_time[point.time_ns]
        middle = 0.5 * (estimate.lower_limit + estimate.upper_limit)
        reach = 0.5 * (estimate.upper_limit - estimate.lower_limit)
        off = (estimate.prediction + estimate.residual - middle) / reach
        assert off == pytest.approx(point.statistic / point.upper_limit, abs=1e-9)


def test_predictions_are_made_before_the_sample_is_seen(leak: list[Encoded], published: list[Publication]) -> None:
    """What is predicted for a row does not change when that row's own value does."""
    _, other = watch([*leak[: 3 * 900 - 1], sample("T", 899, 89.9, 500.0)])
    last = [item for item in other if isinstance(item.message, Estimate)][-1]
    (plain,) = (
        item.message
        for item in published
        if isinstance(item.message, Estimate) and (item.key, item.message.time_ns) == (last.key, last.message.time_ns)
    )
    assert isinstance(last.message, Estimate)
    assert last.message.prediction == plain.prediction
    assert last.message.residual != plain.residual


def test_estimates_carry_limits_only_when_they_are_known(published: list[Publication]) -> None:
    estimates = [item.message for item in published if item.key.endswith("estimate/T")]
    known = [not math.isnan(e.lower_limit) for e in estimates if isinstance(e, Estimate)]
    first = known.index(True)
    assert all(known[first:])
    assert estimates[first].time_ns == to_time_ns(100.0)


def test_models_are_published_in_the_units_of_the_samples(leak: list[Encoded]) -> None:
    """The parameters after a row predict what the estimate of the next says, from the samples as they are."""
    time_min, columns = leaking_run(-0.1, ONSET_MIN, 160.0, seed=1)
    _, published = watch(leak, MonitorConfig(reference="arx"))
    models = [item.message for item in published if item.key.endswith("model/T")]
    reference = next(model for model in models if isinstance(model, ModelSnapshot) and model.reference)
    p = {item.name: item.value for item in reference.parameters}
    row = 1001
    T, qc = columns["T"], columns["qc"]
    lags = range(1, reference.order + 1)
    by_hand = p["c"] + sum(p[f"a{lag}"] * T[row - lag] + p[f"b{lag}"] * qc[row - lag] for lag in lags)
    estimate = next(
        item.message for item in published
        if item.key.endswith("estimate/T") and item.message.time_ns == to_time_ns(float(time_min[row]))
    )  # fmt: skip
    assert isinstance(estimate, Estimate)
    assert estimate.prediction == pytest.approx(by_hand, rel=1e-9)
    assert all(item.sd > 0 for item in reference.parameters)
    assert reference.rows >= 500


def reference_of(published: list[Publication]) -> ModelSnapshot:
    """The identified model of T that is held since the training."""
    models = [item.message for item in published if item.key.endswith("model/T")]
    return next(model for model in models if isinstance(model, ModelSnapshot) and model.held)


@pytest.mark.parametrize(
    ("setting", "judge"),
    [("auto", "equations"), ("process", "equations"), ("black-box", "black-box"), ("arx", "arx")],
)
def test_the_reference_in_use_is_published_with_its_noise_levels_and_no_other_is_marked_as_in_use(
    leak: list[Encoded], setting: Literal["auto", "process", "black-box", "arx"], judge: str
) -> None:
    monitor, published = watch(leak, MonitorConfig(reference=setting, isolation=False))
    models = [(item.key, item.message) for item in published if isinstance(item.message, ModelSnapshot)]
    since_ns = monitor.memory.watching_since_ns
    assert since_ns is not None
    for key in ("reactor/cstr/model/C", "reactor/cstr/model/T"):
        judging = [model for where, model in models if where == key and model.reference]
        assert {model.structure for model in judging} == {judge}
        assert min(model.time_ns for model in judging) == since_ns
        assert [model.time_ns for model in judging] == sorted({model.time_ns for model in judging})
    assert monitor.pipeline.reference == judge
    reference = monitor.pipeline.evaluation.reference
    assert reference is not None
    levels = reference.noise_levels
    assert (levels is not None) == (judge == "equations")
    if levels is not None:
        for signal, sd in levels["sensors"].items():
            model = next(item for where, item in models if where.endswith(signal) and item.structure == "equations")
            values = {item.name: item.value for item in model.parameters}
            assert values == {"sensor_sd": sd} | {f"{name}_sd": value for name, value in levels["states"].items()}
        assert levels["sensors"]["T"] == pytest.approx(0.3, rel=0.2)  # as the plant was made


def test_health_reports_the_progress_of_the_training_and_then_the_reference(leak: list[Encoded]) -> None:
    """In a training of 100 min."""
    monitor = Monitor(MonitorConfig(isolation=False), 0)
    progress: list[tuple[float, str]] = []
    for number, message in enumerate(leak, start=1):
        monitor.on_message(message, 0)
        if number % 300 == 0:
            now = [item.message for item in monitor.on_tick(number * 10**9) if isinstance(item.message, Health)]
            progress += [(report.training, report.reference) for report in now]
    shares = [share for share, _ in progress]
    assert shares == sorted(shares)
    assert shares[4] == pytest.approx(0.49, abs=0.03)
    assert {reference for share, reference in progress if share < 1.0} == {""}
    assert progress[-1] == (1.0, "equations")


def test_the_reference_reports_that_its_rows_were_fit_to_learn_from(published: list[Publication]) -> None:
    checks = {check.name: check.result for check in reference_of(published).checks}
    assert {"variation", "excitation", "sampling", "conditioning", "amplitude", "whiteness", "independence"} <= set(
        checks
    )
    assert checks["excitation"] == checks["variation"] == "ok"


def test_the_reference_reports_that_a_single_sinusoid_does_not_excite_it() -> None:
    """A sinusoid excites order 2; three lags of the output and three of the input need 6."""
    time_min, columns = leaking_run(0.0, 1.0, 110.0, seed=3)
    columns["qc"] = 100.0 + 5.0 * np.sin(2 * np.pi * time_min / 8.0)
    _, published = watch(samples(time_min, columns))
    checks = {check.name: check.result for check in reference_of(published).checks}
    assert checks["excitation"] != "ok"


def garbage() -> list[tuple[str, Encoded]]:
    """What may come on the keys of a plant, and the reason it is counted under."""
    good = sample("T", 5000, 500.0, 440.0)
    no_number = sample("T", 5000, 500.0, math.nan)
    without_end = sample("T", 5000, 500.0, math.inf)
    bare = Sample(time_ns=to_time_ns(500.0), value=440.0)
    bad = Sample(time_ns=to_time_ns(500.0), value=440.0, quality=Quality.QUALITY_BAD)
    unknown = Sample(time_ns=to_time_ns(500.0), value=440.0, quality=7)  # type: ignore[arg-type]
    key = keys.key(PLANT, keys.SAMPLE, "T")
    return [
        ("not_finite", no_number),
        ("not_finite", without_end),
        ("payload", good._replace(payload=b"\xff\xff\xff\xff")),
        ("payload", good._replace(payload=b"")),
        ("payload", encode(Publication(key, bare))),
        ("bad_quality", encode(Publication(key, bad))),
        ("bad_quality", encode(Publication(key, unknown))),
        ("out_of_range", sample("T", 5000, 500.0, 1e300)),
        ("out_of_range", sample("T", 2**64 - 1, 500.0, 440.0)),
        ("out_of_range", sample("T", 5000, 1.5e8, 440.0)),
        ("too_large", good._replace(payload=b"\x22" * 10_000_000)),
        ("encoding", good._replace(encoding="application/json")),
        ("version", good._replace(encoding="application/protobuf;reactorwatch.v2.Sample")),
        ("encoding", encode(Publication(key, Health(time_ns=1)))),
        ("unknown_signal", good._replace(key=keys.key(PLANT, keys.SAMPLE, "pH"))),
        ("unknown_signal", good._replace(key="reactor/cstr/sample")),
    ]


def test_garbage_is_counted_by_reason_and_harms_nothing(leak: list[Encoded], encoded: list[Encoded]) -> None:
    dirty: list[Encoded] = []
    for index, message in enumerate(leak):
        dirty.append(message)
        if index % 300 == 0:
            dirty += [item for _, item in garbage()]
    monitor, published = watch(dirty)
    times = sum(index % 300 == 0 for index in range(len(leak)))
    counted = health(monitor)
    reasons: dict[str, int] = {}
    for reason, _ in garbage():
        reasons[reason] = reasons.get(reason, 0) + times
    assert dict(counted.refused_by_reason) == reasons
    assert counted.refused == sum(reasons.values())
    assert counted.received == len(dirty)
    assert [encode(item) for item in published] == encoded


def test_foreign_messages_on_the_plant_s_keys_are_counted_and_harm_nothing(
    leak: list[Encoded], encoded: list[Encoded]
) -> None:
    """A second plant of the same name, with a clock and numbers of its own, from the training until after the fault."""
    time_min, columns = leaking_run(0.0, 1.0, 150.0, seed=9)
    theirs = list(samples(time_min + 777.03, {name: values + 0.01 * values for name, values in columns.items()}))
    mixed = leak[:600]
    for place in range(len(theirs) - 600):
        mixed += [leak[600 + place], theirs[place]]
    mixed += leak[600 + len(theirs) - 600 :]
    monitor, published = watch(mixed)
    assert [encode(item) for item in published] == encoded
    assert health(monitor).refused_by_reason["out_of_place"] == len(theirs) - 600


def test_the_lag_of_a_batch_is_that_of_the_oldest_message_with_a_time_of_receipt(leak: list[Encoded]) -> None:
    monitor = Monitor(CONFIG, 0)
    received_ns = (10**9, 0, 3 * 10**9)
    batch = [message._replace(received_ns=ns) for message, ns in zip(leak, received_ns, strict=False)]
    monitor.on_messages(batch, 5 * 10**9)
    assert health(monitor).lag_ms == 4000.0


def test_a_monitor_that_did_not_run_when_something_was_due_counts_it() -> None:
    """Its health is due every five seconds; it was frozen, or its clock was set, between the second and the third."""
    monitor, second = Monitor(CONFIG, 10**18), 10**9
    seen = []
    for now_s in (40, 45, 50, 3650, 3655):  # first it waited for a router
        (publication,) = monitor.on_tick(10**18 + now_s * second)
        assert isinstance(publication.message, Health)
        seen.append(publication.message.stalls)
    assert seen == [0, 0, 0, 1, 1]


def test_a_gap_is_a_silence_and_nothing_else() -> None:
    time_min, columns = leaking_run(0.0, 1.0, 160.0, seed=2)
    keep = (time_min < 120) | (time_min > 125)
    _, published = watch(samples(time_min[keep], {name: values[keep] for name, values in columns.items()}))
    assert {alarm.alarm for alarm in messages_of(published, Alarm)} == {"silence/plant"}
    after = [
        item.message.time_ns
        for item in published
        if isinstance(item.message, ChartPoint) and item.message.time_ns > to_time_ns(120)
    ]
    assert min(after) >= to_time_ns(125.1)  # the first row only tells where the plant is


@pytest.mark.parametrize(("starts_min", "alarms"), [(300.0, {"silence/plant"}), (0.0, set[str]())])
def test_a_publisher_that_begins_again_later_or_earlier_is_watched_on(starts_min: float, alarms: set[str]) -> None:
    time_min, columns = leaking_run(0.0, 1.0, 160.0, seed=2)
    again = samples(time_min[:300] + starts_min, {name: values[:300] for name, values in columns.items()})
    monitor, published = watch([*samples(time_min, columns), *again])
    assert {alarm.alarm for alarm in messages_of(published, Alarm)} == alarms
    counted = health(monitor)
    assert counted.rows == time_min.size + 300
    assert counted.late == counted.lost == 0
    assert messages_of(published, Estimate)[-1].time_ns == to_time_ns(float(time_min[299]) + starts_min)


def test_a_constant_plant_neither_fails_nor_alarms() -> None:
    time_min = np.arange(2000) / 10
    columns = {"qc": np.full(2000, 100.0), "C": np.full(2000, 0.1), "T": np.full(2000, 438.54)}
    monitor, published = watch(samples(time_min, columns))
    assert monitor.phase == "watching"
    assert messages_of(published, Alarm) == []


def test_a_record_shorter_than_the_training_is_never_judged() -> None:
    result = backtest.run(samples(*leaking_run(-0.1, 30.0, 60.0, seed=1)), CONFIG)
    assert result.watching_since_ns is None
    assert result.alarm_messages == []


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({"order": 0}, r"order must be in \[1, 20\], got 0"),
        ({"forgetting": 1.2}, r"forgetting must be in \[0.5, 1\], got 1.2"),
        ({"raise_count": 6}, r"raise_count must be in \[1, window\]"),
        ({"plant": "a/b"}, r"plant name must be"),
        ({"outputs": ("qc",)}, r"outputs must be"),
        ({"priorities": {"pH": "high"}}, r"priorities are by output"),
    ],
)
def test_settings_that_break_a_rule_are_refused(setting: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        MonitorConfig(**setting)  # type: ignore[arg-type]


def test_a_training_full_of_holes_is_reported_and_harms_nothing() -> None:
    time_min, columns = leaking_run(0.0, 1.0, 160.0, seed=4)
    kept = np.arange(time_min.size) % 9 != 0
    monitor, published = watch(samples(time_min[kept], {name: values[kept] for name, values in columns.items()}))
    assert monitor.phase == "watching"
    assert [check.name for check in reference_of(published).checks] == ["record", "training"]


@pytest.mark.parametrize("reference", ["process", "arx"])
def test_whether_points_are_published_or_not_the_alarms_are_the_same(
    reference: Literal["process", "arx"], leak: list[Encoded]
) -> None:
    """Without them, the model that adapts does not learn before somebody asks for what it predicts."""
    config = MonitorConfig(reference=reference, isolation=False)
    alarms = []
    for points in (True, False):
        monitor = Monitor(config, 0, points=points)
        published = [item for message in leak for item in monitor.on_message(message, 0)]
        alarms.append([item.message for item in published if isinstance(item.message, Alarm)])
    assert alarms[0] == alarms[1]
    assert alarms[0]
