"""Files that a user names have bounds, which are checked before the work; settings raise them."""

import ast
import json
import os
import socket
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from reactorwatch.cli.main import LIMITS_FILE, main
from reactorwatch.description.process import Process, Signal
from reactorwatch.description.read import find_process, read_extended_model
from reactorwatch.errors import InputError
from reactorwatch.limits import Limits, limits, parse_json, parse_toml, set_limits
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.records.file_format import FileFormat
from reactorwatch.runtime.config import read_settings
from reactorwatch.runtime.jobs import ProcessExecutor, SerialExecutor
from tests.unit.runtime.work import limits_in_force

ROOT = Path(__file__).parents[2]
PRODUCT = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node")


@pytest.fixture(autouse=True)
def _default_limits() -> Iterator[None]:
    set_limits(Limits())
    yield
    set_limits(Limits())


# --- TOML and JSON --------------------------------------------------------------------------------------------------

DOTS = 50_000
STEP = '["a", "b"]'
HOSTILE_TOML = {
    "dotted key": ("a" + ".a" * DOTS + " = 1", "key_characters"),
    "dotted key with blanks": ("a" + " . a" * DOTS + " = 1", "key_characters"),
    "dotted key of quoted parts": ('"a"' + ".'a'" * DOTS + " = 1", "key_characters"),
    "dotted table": ("[a" + ".a" * DOTS + "]", "key_characters"),
    "dotted table of an array": ("[[a" + ".a" * DOTS + "]]", "key_characters"),
    "dotted key in an inline table": ("x = {a" + ".a" * DOTS + " = 1}", "key_characters"),
    "dotted key after texts and comments": (
        's = """ # "\\" \' """ # """ \n t = \'\'\' # " \'\'\'\n' + "a" + ".a" * DOTS + " = 1",
        "key_characters",
    ),
    "long key": ("a" * 257 + " = 1", "key_characters"),
    "long quoted key": ('"' + "a" * 257 + '" = 1', "key_characters"),
    "many short dots": ("a" + ".a" * 60 + " = 1", "depth"),
    "nested lists": ("x = " + "[" * 51 + "]" * 51, "depth"),
    "very nested lists": ("x = " + "[" * 100_000, "depth"),
    "nested inline tables": ("x = " + "{a = " * 51 + "1" + "}" * 51, "depth"),
    "size": ("#" * 10_000_001, "file_bytes"),
}
HOSTILE_JSON = {
    "long key": (json.dumps({"a" * 257: 1}), "key_characters"),
    "nested lists": ("[" * 51 + "]" * 51, "depth"),
    "very nested lists": ("[" * 1_000_000, "depth"),
    "nested objects": ('{"a":' * 51 + "1" + "}" * 51, "depth"),
    "size": (" " * 10_000_001, "file_bytes"),
}


@pytest.mark.parametrize("kind", HOSTILE_TOML)
def test_toml_beyond_a_bound_is_refused_in_a_line_that_names_the_setting(kind: str) -> None:
    text, limit = HOSTILE_TOML[kind]
    with pytest.raises(
        InputError, match=rf"at most .*, got .*{limit} in \[limits\] of the settings raises this"
    ) as found:
        parse_toml(text.encode())
    assert "\n" not in str(found.value)
    assert len(str(found.value)) < 200


@pytest.mark.parametrize("kind", HOSTILE_JSON)
def test_json_beyond_a_bound_is_refused_in_a_line_that_names_the_setting(kind: str) -> None:
    text, limit = HOSTILE_JSON[kind]
    with pytest.raises(InputError, match=rf"at most .*, got .*{limit} in \[limits\] of the settings raises this"):
        parse_json(text)
    with pytest.raises(InputError, match=rf"{limit} in \[limits\]"):
        parse_extended_model(text)


texts = st.text(st.sampled_from("ab1 .\"'#=[]{}\\\nä-_"), max_size=12)
trees = st.recursive(
    st.integers(-9, 9) | texts | st.booleans() | st.floats(-1e3, 1e3),
    lambda item: st.lists(item, max_size=3) | st.dictionaries(texts, item, max_size=3),
    max_leaves=12,
)


def depth_of(tree: Any) -> int:
    if not isinstance(tree, dict | list):
        return 0
    return 1 + max(map(depth_of, tree.values() if isinstance(tree, dict) else tree), default=0)


def keys_of(tree: Any, above: str = "") -> Iterator[str]:
    """Keys, each with those above it, as a document may write them."""
    items = (
        tree.items() if isinstance(tree, dict) else ((None, item) for item in tree) if isinstance(tree, list) else ()
    )
    for key, item in items:
        full = above if key is None else f"{above}.{json.dumps(key)}"
        yield full
        yield from keys_of(item, full)


@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(texts, trees, max_size=4), st.integers(1, 6), st.integers(1, 14))
def test_a_document_is_read_as_the_library_reads_it_unless_it_is_beyond_a_bound(
    tree: dict[str, Any], depth: int, characters: int
) -> None:
    set_limits(Limits(depth=depth, key_characters=characters))
    longest = max(map(len, (key for item in [tree] for key in _plain_keys(item))), default=0)
    is_within = depth_of(tree) <= depth and longest <= characters
    try:
        assert parse_json(json.dumps(tree)) == tree
        assert is_within
    except InputError:
        assert not is_within
    text = tomli_w.dumps(tree)
    read: Any = None
    reason = ""
    try:
        read = parse_toml(text.encode())
    except InputError as error:
        reason = str(error)
    if not reason:
        assert is_within
        assert read == tomllib.loads(text) == tree
    elif is_within:  # a key that is written with those above it has all their characters
        assert "key_characters" in reason
        assert max(map(len, keys_of(tree))) > characters


def _plain_keys(tree: Any) -> Iterator[str]:
    if isinstance(tree, dict):
        yield from tree
    for item in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        yield from _plain_keys(item)


def test_all_toml_and_json_of_others_is_read_here() -> None:
    """The rest reads what this process has itself asked for: its worker's answer, and its own configuration."""
    own = {"reactorwatch/limits.py", "diagnosis_node/__main__.py", "reactorwatch/runtime/bus_zenoh/sessions.py"}
    found = set()
    for path in (path for package in PRODUCT for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in (
                *("tomllib.loads", "tomllib.load", "json.loads", "json.load"),
                *("msgspec.json.decode", "msgspec.toml.decode", "msgspec.json.Decoder"),
            ):
                found.add(str(path.relative_to(ROOT)))
    assert found == own


# --- numbers of things ----------------------------------------------------------------------------------------------

SIGNALS = '\n[[signals]]\nname = "q"\nrole = "input"\n[[signals]]\nname = "y"\nrole = "output"\n'


def with_missing(number: int) -> str:
    return f'name = "rig"\nmissing = {list(range(-number, 0))}{SIGNALS}'


def with_effects(number: int) -> str:
    effects = ["coolant_flow:step:-0.05@312min"] * number
    return json.dumps({"format": "reactorwatch.model.v1", "model": "cstr", "effects": effects})


def with_steps(number: int) -> str:
    equations = {
        "states": [{"name": "x", "unit": "1", "meaning": "level", "scale": 1.0}],
        "inputs": [{"name": "q", "unit": "1", "meaning": "flow"}],
        "parameters": [],
        "outputs": [{"name": "y", "unit": "1"}],
        "steps": [["symbol", 0], *(["neg", index] for index in range(number - 1))],
        "results": [number - 1, 0, 0],
    }
    return json.dumps({"format": "reactorwatch.model.v1", "model": "rig", "equations": equations})


NUMBERS: dict[str, tuple[Callable[[int], str], str, int]] = {
    "missing": (with_missing, "process.toml", 1_000),
    "effects": (with_effects, "process.json", 1_000),
    "equations": (with_steps, "process.json", 10_000),
}


@pytest.mark.parametrize("limit", NUMBERS)
def test_one_thing_too_many_is_refused_before_the_work_and_as_many_as_allowed_are_not(
    limit: str, tmp_path: Path
) -> None:
    write, name, largest = NUMBERS[limit]
    path = tmp_path / name
    assert getattr(Limits(), limit) == largest
    for number in (largest + 1, 100_000):
        path.write_text(write(number), encoding="utf-8")
        with pytest.raises(InputError, match=rf"^process file {path}: .* at most {largest}, got {number}; {limit} in"):
            find_process(path)
    set_limits(Limits(**{limit: 20}))
    path.write_text(write(20), encoding="utf-8")
    assert find_process(path).outputs


@pytest.mark.parametrize("limit", NUMBERS)
def test_settings_raise_a_bound(limit: str, tmp_path: Path) -> None:
    write, name, _ = NUMBERS[limit]
    set_limits(Limits(**{limit: 5}))
    path, config = tmp_path / name, tmp_path / "settings.toml"
    path.write_text(write(20), encoding="utf-8")
    with pytest.raises(InputError, match=f"{limit} in"):
        find_process(path)
    config.write_text(f"[limits]\n{limit} = 20\n", encoding="utf-8")
    read_settings(config)
    assert find_process(path).outputs


def test_cells_that_mean_not_measured_are_as_many_by_option() -> None:
    with pytest.raises(InputError, match=r"--missing: .* must be at most 1000, got 1001"):
        FileFormat(missing=tuple(map(str, range(1001))))


@pytest.mark.parametrize("text", ["depth = 501", "depth = 0", "missing = 0", "widht = 3", 'effects = "many"'])
def test_a_limit_that_is_none_is_refused_and_changes_nothing(text: str, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text(f"[limits]\nequations = 7\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"settings \[limits\]"):
        read_settings(tmp_path / "settings.toml")
    assert limits() == Limits()


def test_a_command_without_settings_takes_the_limits_of_the_file_that_the_environment_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "many.toml").write_text(with_missing(1_001), encoding="utf-8")
    (tmp_path / "settings.toml").write_text("[limits]\nmissing = 1001\n", encoding="utf-8")
    (tmp_path / "run.csv").write_text("time_min,q,y\n0,1,2\n1,1,3\n2,1,4\n", encoding="utf-8")
    arguments = ["reactorwatch", "info", str(tmp_path / "run.csv"), "--process", str(tmp_path / "many.toml")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "missing in [limits]" in capsys.readouterr().err
    monkeypatch.setenv(LIMITS_FILE, str(tmp_path / "settings.toml"))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0


def test_workers_have_the_limits_of_the_process_that_started_them() -> None:
    set_limits(Limits(missing=77))
    for executor in (SerialExecutor(), ProcessExecutor(2)):
        assert [found for _, found in executor.map_unordered(limits_in_force, [0, 1])] == [Limits(missing=77)] * 2


# --- what is no regular file ----------------------------------------------------------------------------------------


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def local_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(str(path))


READERS: dict[str, Callable[[Path], object]] = {
    ".toml": find_process,
    ".py": find_process,
    ".json": find_process,
    " settings.toml": read_settings,
    " model.json": read_extended_model,
}


@pytest.mark.parametrize("make", [pipe, device, local_socket, Path.mkdir])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_regular_file_is_refused_at_once(reader: str, make: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / f"x{reader}"
    make(path)
    with pytest.raises(InputError, match=rf"^\w+ file {path}: is not a regular file; name one$"):
        READERS[reader](path)


# --- code of the user -----------------------------------------------------------------------------------------------

RAISED = {
    "text raises": "class E(Exception):\n    def __str__(self): raise RuntimeError\ndef process(): raise E",
    "text is no text": "class E(Exception):\n    def __str__(self): return 5\ndef process(): raise E",
    "exit": "import sys\ndef process(): sys.exit(0)",
    "exit on import": "raise SystemExit(3)",
    "no Exception": "class E(BaseException): pass\ndef process(): raise E('x')",
    "arguments that compare to nothing": (
        "class A:\n    def __eq__(self, other): raise ValueError\n    __hash__ = None\n"
        "def process(): raise Exception(A())"
    ),
    "several lines": "def process(): raise ValueError('a\\nb')",
    "recursion": "def process(): return process()",
}


@pytest.mark.parametrize("kind", RAISED)
def test_any_exception_of_a_process_file_is_one_line_and_exit_code_2(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "own.py"
    path.write_text(RAISED[kind], encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "causes", "--process", str(path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"reactorwatch: process file {path}: ")


def test_equations_without_a_state_are_refused() -> None:
    text = json.loads(with_steps(3))
    text["equations"] |= {"states": [], "steps": [["symbol", 0]], "results": [0, 0]}
    with pytest.raises(InputError, match="at least one state"):
        parse_extended_model(json.dumps(text))


class CountedName(str):
    """A name that counts comparisons."""

    __slots__ = ()
    compared = 0

    def __eq__(self, other: object) -> bool:
        CountedName.compared += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_the_work_for_a_description_grows_with_its_signals_and_not_with_their_square() -> None:
    signals = tuple(Signal(CountedName(f"y{number}")) for number in range(2_000))
    assert len(Process("rig", signals).outputs) == 2_000
    assert CountedName.compared < 20 * 2_000
    with pytest.raises(InputError, match="got 'y7' for"):
        Process("rig", (*signals, signals[7]))
