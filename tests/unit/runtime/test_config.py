"""Settings: defaults, then the file, then the flags; one line names table, key, rule and value of whatever is wrong."""

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig
from plant_node.config import PlantConfig
from reactorwatch.cli.processes import write_settings
from reactorwatch.cli.up import diagnosis_settings
from reactorwatch.errors import InputError
from reactorwatch.limits import Limits
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import (
    MAX_SPAN_S,
    PROTOCOLS,
    SECTIONS,
    BusConfig,
    LogConfig,
    MetricsConfig,
    check_endpoint,
    read_settings,
    section,
    valid_choices,
)
from recorder.config import RecorderConfig, ReplayConfig
from recorder.keep import BlackBox


def settings_file(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_flags_outdo_the_file_and_the_file_the_defaults(tmp_path: Path) -> None:
    tables = read_settings(settings_file(tmp_path, "[monitor]\norder = 2\ntraining_min = 50.0\n"))
    config = section(MonitorConfig, "monitor", tables, {"order": 4, "forgetting": None})
    assert (config.order, config.training_min, config.forgetting) == (4, 50.0, MonitorConfig().forgetting)


def test_without_a_file_all_is_default_and_the_bus_is_on_loopback() -> None:
    assert section(BusConfig, "bus", read_settings(None), {}) == BusConfig(endpoint="tcp/127.0.0.1:7447")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[monitr]\n", "unknown table 'monitr'; did you mean 'monitor'? (valid: bus, plant, monitor"),
        (
            "[monitor]\ntraning_min = 1\n",
            "unknown key 'traning_min'; did you mean 'training_min'? (valid: ewma_weight,",
        ),
        ("[monitor]\ntraining_min = 'long'\n", "training_min"),
        ("[monitor]\ntraining_min = -5.0\n", "training_min must be in [0.001, 1e+06], got -5"),
        ("monitor = 3\n", "'monitor' must be a table, like [monitor]"),
        ("[monitor\n", "is not TOML"),
        ("[monitor]\nplant = 'a/b'\n", "plant name must be"),
    ],
)
def test_an_error_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        section(MonitorConfig, "monitor", read_settings(settings_file(tmp_path, text)), {})
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.toml: cannot be read: No such file"):
        read_settings(tmp_path / "nowhere.toml")


def test_settings_that_are_written_are_read_as_they_were(tmp_path: Path) -> None:
    written: dict[str, msgspec.Struct] = {
        "bus": BusConfig(endpoint="tcp/127.0.0.1:9999"),
        "plant": PlantConfig(speed=float("inf"), faults=("coolant_flow:step:-0.1@30min",), duration_min=60.0),
        "monitor": MonitorConfig(order=2),
        "recorder": RecorderConfig(out="somewhere"),
        "replay": ReplayConfig(file="a.csv"),
        "diagnosis": DiagnosisConfig(out="reports", tolerance={"T": 0.5}),
    }
    path = tmp_path / "settings.toml"
    write_settings(path, written)
    tables = read_settings(path)
    for name, settings in written.items():
        assert section(type(settings), name, tables, {}) == settings


def test_a_key_that_has_no_effect_any_more_is_still_read() -> None:
    tables = {"monitor": {"alarm_state_file": "alarms.state", "state_file": "monitor.state"}}
    assert section(MonitorConfig, "monitor", tables, {}).state_file == "monitor.state"


def test_an_older_name_of_a_key_is_valid_and_both_together_are_not() -> None:
    assert section(MonitorConfig, "monitor", {"monitor": {"input": "u"}}, {}).inputs == ("u",)
    assert section(MonitorConfig, "monitor", {"monitor": {"input": "u"}}, {"inputs": ("a", "b")}).inputs == ("a", "b")
    with pytest.raises(InputError, match=r"'input' is an older name of 'inputs', got both; leave 'input' out"):
        section(MonitorConfig, "monitor", {"monitor": {"input": "u", "inputs": ["u"]}}, {})


TABLES: dict[str, type[msgspec.Struct]] = {
    "bus": BusConfig,
    "plant": PlantConfig,
    "monitor": MonitorConfig,
    "fleet": FleetConfig,
    "recorder": RecorderConfig,
    "replay": ReplayConfig,
    "diagnosis": DiagnosisConfig,
    "metrics": MetricsConfig,
    "log": LogConfig,
    "limits": Limits,
}
KEYS = [(table, field.name) for table, kind in TABLES.items() for field in msgspec.structs.fields(kind)]

scalars = (
    st.sampled_from([0, -1, 1, 2**62, 2**70, 10**400, 1e308, -1e308, 1e-320, math.nan, math.inf, -math.inf])
    | st.sampled_from(["", "x", "a\0b", "ü", "x" * 300, "a/b", "\x1b[31m", "tcp/127.0.0.1:99999", "foo/127.0.0.1:1"])
    | st.booleans()
    | st.floats()
    | st.text(max_size=5)
)
names = st.sampled_from(["C", "T", "t", "kind", ""])
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(names, inner))


def test_every_table_is_tried() -> None:
    assert TABLES.keys() == set(SECTIONS)


@given(key=st.sampled_from([*KEYS, ("plant", "preset")]), value=values)
@example(key=("plant", "preset"), value=["x"])
@example(key=("recorder", "black_box_min"), value=1e308)
@example(key=("recorder", "about"), value={"seed": "a\0b"})
@example(key=("plant", "duration_min"), value=1e308)
@example(key=("replay", "from_min"), value=1e308)
def test_any_value_of_any_setting_is_valid_or_one_line(key: tuple[str, str], value: Any) -> None:
    table, name = key
    given_file = {"file": "run.csv"} if table == "replay" else {}
    refused = ""
    try:
        found = section(TABLES[table], table, {table: {**given_file, name: value}}, {})
    except InputError as error:
        refused = str(error)
    if refused:
        assert refused.startswith(f"settings [{table}]: ")
        assert "\n" not in refused
        assert "Invalid enum value" not in refused
        return
    if isinstance(found, RecorderConfig):
        assert BlackBox(round(found.black_box_min * MINUTE_NS)).longest_ns >= 0
    if isinstance(found, PlantConfig):
        assert found.rows is None or found.rows > 0


SPANS = [(table, name) for table, name in KEYS if re.search(r"(?<!_l)_(s|min|h|days)$", name)]


@pytest.mark.parametrize(("table", "name"), SPANS)
def test_no_duration_is_longer_than_146_years(table: str, name: str) -> None:
    given_file = {"file": "run.csv"} if table == "replay" else {}
    for value in (MAX_SPAN_S * 1.001, 1e300):
        with pytest.raises(InputError, match=f"{name} must be"):
            section(TABLES[table], table, {table: {**given_file, name: value}}, {})


@pytest.mark.parametrize(
    ("table", "name", "path", "word"),
    [
        ("log", "format", "$.format", "json"),
        ("bus", "congestion", "$.congestion", "block"),
        ("monitor", "reference", "$.reference", "arx"),
        ("monitor", "charts", "$.charts[0]", "ewma"),
        ("monitor", "priorities", "$.priorities[...]", "critical"),
        ("recorder", "fsync", "$.fsync", "chunk"),
        ("plant", "start", "$.start", "extinguished"),
    ],
)
def test_an_error_on_a_choice_lists_the_valid_words(table: str, name: str, path: str, word: str) -> None:
    assert word in valid_choices(TABLES[table], path)
    value: Any = {"charts": ["foo"], "priorities": {"T": "foo"}}.get(name, "foo")
    with pytest.raises(
        InputError, match=rf"settings \[{table}\]: {name}.*: unknown word 'foo'.* \(valid: .*\b{word}\b.*\)"
    ):
        section(TABLES[table], table, {table: {name: value}}, {})


BOUNDED = [
    (table, item.encode_name, meta)
    for table, kind in TABLES.items()
    for item in msgspec.inspect.type_info(kind).fields  # type: ignore[attr-defined]
    for meta in (item.type, *getattr(item.type, "types", ()))
    if getattr(meta, "ge", None) is not None
]


def test_every_table_with_bounds_is_tried() -> None:
    assert {table for table, _, _ in BOUNDED} == {
        "bus",
        "plant",
        "monitor",
        "fleet",
        "recorder",
        "diagnosis",
        "metrics",
        "limits",
    }


@pytest.mark.parametrize(("table", "name", "bounds"), BOUNDED, ids=[f"{table}.{name}" for table, name, _ in BOUNDED])
def test_a_number_out_of_its_bounds_is_named_with_them_from_a_file_and_in_python(
    table: str, name: str, bounds: Any
) -> None:
    for value in (bounds.ge - 1, bounds.le + 1 if bounds.le < 2**63 - 1 else bounds.ge - 2):
        line = re.escape(f"{name} must be in [{bounds.ge:g}, {bounds.le:g}], got {value:g}")
        with pytest.raises(InputError, match=rf"^settings \[{table}\]: {line}$"):
            section(TABLES[table], table, {table: {name: value}}, {})
        with pytest.raises(ValueError, match=rf"^{line}$"):
            TABLES[table](**{name: value})


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("host", ["127.0.0.1", "router.example", "[::1]"])
def test_endpoints_of_every_protocol_are_taken(protocol: str, host: str) -> None:
    for port in (1, 7447, 65535):
        assert check_endpoint(f"{protocol}/{host}:{port}") == f"{protocol}/{host}:{port}"


@pytest.mark.parametrize("key", ["endpoint", "routers"])
@pytest.mark.parametrize(
    ("endpoint", "stated"),
    [
        *((f"tcp/127.0.0.1:{port}", "port of an endpoint must be in") for port in (0, 65536, 99999, "1" * 5000, "x²")),
        *((f"{protocol}/127.0.0.1:1", "one of tcp/, tls/, udp/, ws/") for protocol in ("foo", "TCP", "http", " tcp")),
        *((text, "endpoint must be like") for text in ("foo/", "tcp/", "tcp/:1", "a/b/c:1", "127.0.0.1:1")),
    ],
)
def test_an_endpoint_that_can_never_be_reached_is_refused_at_once(key: str, endpoint: str, stated: str) -> None:
    table = {key: [endpoint] if key == "routers" else endpoint}
    with pytest.raises(InputError, match=stated):
        section(BusConfig, "bus", {"bus": table}, {})


@pytest.mark.parametrize("out", [None, "reports"])
@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan, math.inf])
def test_a_tolerance_that_cannot_be_is_refused_before_anything_runs(value: float, out: str | None) -> None:
    with pytest.raises(InputError, match=r"settings \[diagnosis\]: tolerance of T must be a positive number"):
        diagnosis_settings({"diagnosis": {"out": out, "tolerance": {"T": value}}}, MonitorConfig(), None)


def test_a_tolerance_of_no_output_is_refused_before_anything_runs() -> None:
    with pytest.raises(InputError, match=r"settings \[diagnosis\]: tolerance must be of C, T, got t"):
        diagnosis_settings({"diagnosis": {"out": "reports", "tolerance": {"t": 1.0}}}, MonitorConfig(), None)


def test_a_smallest_sd_of_no_output_is_refused() -> None:
    with pytest.raises(InputError, match=r"smallest_sd is by output, \('C', 'T'\), got 't'"):
        section(MonitorConfig, "monitor", {"monitor": {"smallest_sd": {"t": 0.05}}}, {})
    tank = {"outputs": ["h"], "smallest_sd": {"h": 1.0}, "priorities": {}}
    section(MonitorConfig, "monitor", {"monitor": tank}, {})
