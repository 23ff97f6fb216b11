"""Strange command lines of every command: none ends in a traceback, and a mistake is one line and exit code 2."""

import inspect
import os
import random
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import typer
import zenoh

from reactorwatch.cli.processes import Processes
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.provisioning import make_site
from tests.unit.cli.test_crash import files as files
from tests.unit.cli.test_crash import folder as folder
from tests.unit.cli.test_crash import run
from tests.unit.cli.test_outputs import commands

Shown = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch

VALUES = [
    *["-1", "0", "1", "2", "1e308", "-1e308", "nan", "inf", "1e-320", "1e400", "-0", "x", "ü", "a/b", "C", "T"],
    *["C=0.1", "T=nan", "C=1e308", "qc=1..2", "qc=nan..1", "a=b", "T=T", "K3=2%", "K3=1e400%", "10min", "1,2,3"],
    *["arx", "oe", "shewhart", "cusum", "mewma", "t2", "%s", "{}", "coolant_flow:step:-0.05@30min"],
    *["coolant_flow:step:nan@nanmin", "coolant_flow:ramp:1e308", "shewhart/T", "recording/disk", "cstr/monitor"],
    *["max", "plant", "reactor/*", "1/2", "tls/127.0.0.1:7447", "9" * 400, "", "\x1b[31m", "\udcff", "a\nb"],
]
NUMBERS = [
    *["-1", "0", "1", "2", "0.1", "0.3", "200", "1e15", "1e308", "-1e308", "nan", "inf", "-inf", "1e-320", "1e400"],
    "9" * 400,
]
PATHS = [
    *["good.csv", "plant0.mcap", "plant5.mcap", "bad.csv", "none.csv", ".", "*.toml", "x" * 300, "a\nb.csv", ""],
    *["bus.toml", "site", "site/router/router.json5", "site/cstr/viewer/settings.toml", "empty.json5", "\udcff"],
]
OUTPUTS = ["x.csv", "x.mcap", "x.rrd", "good.csv", "x", "", "\udcff", "\udcff.csv", "a\nb", "x" * 300]
NOT_NOW = {"diagnose", "dashboard"}
"""They take seconds; what they read is read by others here."""
LINES = 5
FUZZED = {name: function for name, function in commands() if name not in NOT_NOW}
STRANGE = [
    *["", "x", "tcp/", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/127.0.0.1:99999", "tcp/127.0.0.1:x", "foo/a:1"],
    *["tcp/[::1:1", "tcp/999.999.999.999:1", "tcp/nowhere.invalid:1", "tcp/192.0.2.1:1", "unixsock-stream/x:1"],
    *["tcp/127.0.0.1:1#iface=x", "tcp/127.0.0.1:1?rel=9", "tcp/\udcff:1", "tcp/a\nb:1", "tls/127.0.0.1:1", "ws/x:1"],
]


@pytest.fixture(scope="module")
def taken() -> Iterator[int]:
    """A port that no router can listen at, and at which none answers."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


@pytest.fixture(scope="module")
def whole_site(tmp_path_factory: pytest.TempPathFactory, taken: int) -> Path:
    """A site of two plants, with members for all, whose router cannot listen."""
    site = tmp_path_factory.mktemp("sites") / "site"
    make_site(site, ("cstr", "demo", "*"), f"tls/127.0.0.1:{taken}", None, 30.0, datetime.now(UTC))
    return site


@pytest.fixture
def no_router(folder: Path, taken: int, whole_site: Path, monkeypatch: Patch) -> list[bool]:
    """Commands call routers on the loopback only, and stop after the first try; returns the tries of a command."""
    shutil.copytree(whole_site, folder / "site")
    (folder / "bus.toml").write_text(f'[bus]\nendpoint = "tcp/127.0.0.1:{taken}"\n')
    (folder / "empty.json5").write_text("{}")
    (folder / "bad.csv").write_text("time_min,qc,C,T\n0,1,2,3\n1,1e308,2,3\n")
    really_open, tried = zenoh.open, list[bool]()

    def open_once(config: zenoh.Config) -> zenoh.Session:
        tried.append(True)
        there = config.get_json("connect/endpoints") + config.get_json("listen/endpoints")
        if f"127.0.0.1:{taken}" not in there:
            raise zenoh.ZError("the network is unreachable")
        return really_open(config)

    def not_started(*_: object, **__: object) -> None:
        raise InputError("no process is started here")

    monkeypatch.setattr(zenoh, "open", open_once)
    monkeypatch.setattr(StopSignal, "is_set", property(lambda stop: stop._set.is_set() or bool(tried)))
    monkeypatch.setattr(StopSignal, "wait", lambda stop, _timeout_s=None: stop.is_set)
    monkeypatch.setattr(Processes, "start", not_started)
    monkeypatch.setattr(bus_zenoh, "log_refusals", nullcontext)
    monkeypatch.setattr("recorder.view.viewer.viewer", not_started)
    return tried


def line_of(name: str, function: Callable[..., object], endpoints: list[str], choose: random.Random) -> list[str]:
    """A command line with any of its options and arguments, of strange values."""
    hints = get_type_hints(function, include_extras=True)
    typed, arguments = name.split(), list[str]()
    for parameter in inspect.signature(function).parameters.values():
        kind, *more = get_args(hints[parameter.name]) or (hints[parameter.name],)
        about: Any = next(
            (item for item in (*more, parameter.default) if isinstance(item, typer.models.ParameterInfo)), None
        )
        is_argument = isinstance(about, typer.models.ArgumentInfo)
        if (
            choose.random() > (0.95 if parameter.default is inspect.Parameter.empty else 0.3)
            and parameter.name != "endpoint"
        ):
            continue
        is_path = bool({Path, list[Path]} & {kind, *get_args(kind)})
        is_number = bool({int, float} & {kind, *get_args(kind)})
        of_kind = PATHS if is_path else NUMBERS if is_number and choose.random() < 0.9 else VALUES
        value = choose.choice({"endpoint": endpoints, "out": OUTPUTS}.get(parameter.name, of_kind))
        if is_argument:
            arguments.append(choose.choice(["good.csv", "plant0.mcap", value]) if is_path else value)
            continue
        given = () if about is None else (about.default, *(about.param_decls or ()))  # the first of them is the default
        names = [item for item in given if str(item).startswith("--")]
        typed.append(names[0] if names else f"--{parameter.name.replace('_', '-')}")
        if bool not in (kind, *get_args(kind)):
            typed.append(value)
    return [*typed, *arguments]


@pytest.mark.parametrize("name", FUZZED)
def test_no_command_line_ends_in_a_traceback(
    folder: Path, no_router: list[bool], name: str, taken: int, monkeypatch: Patch, capsys: Shown
) -> None:
    """Exit code 70 would be one; a mistake is one line on standard error, in a folder one for each file that has it."""
    choose = random.Random(name)
    endpoints = [*[f"tcp/127.0.0.1:{taken}"] * len(STRANGE), f"tls/127.0.0.1:{taken}", *STRANGE]
    for _ in range(LINES):
        typed = line_of(name, FUZZED[name], endpoints, choose)
        no_router.clear()
        code = run(typed, monkeypatch)
        said = capsys.readouterr().err
        assert code in (0, 1, 2), (typed, said)
        lines = [line for line in said.splitlines() if line.startswith("reactorwatch: ")]
        complaints = [line.split(": ")[1] for line in lines if ": remark: " not in line]
        most = len(set(complaints)) if any(item in ("", ".") for item in typed) else 1
        assert len(complaints) == (most if code == 2 else 0) or said.startswith("Usage"), (typed, said)
    assert not list((folder / "reports").iterdir())


def mangle(site: Path, choose: random.Random) -> None:
    """Make a site half made: some of its files and folders are not there, damaged, mixed up, or something else."""
    for _ in range(choose.choice((1, 1, 2, 4, 8))):
        there = [path for path in sorted(site.rglob("*")) if path.exists()]
        path, other = choose.choice(there), choose.choice(there)
        content = other.read_bytes() if other.is_file() else b""
        part = path.with_name(f".{path.name}.new")
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        match choose.randrange(8):
            case 0:
                path.touch()
            case 1:
                path.write_bytes(choose.randbytes(50))
            case 2:
                path.mkdir()
            case 3:
                path.symlink_to("nowhere")
            case 4:
                path.write_bytes(content)
            case 5 if not part.exists():
                part.touch()
            case 6 if not part.exists():
                (part / "certificate.pem").mkdir(parents=True)
            case 7 if not path.exists():
                os.mkfifo(path)
            case _:
                pass


CERTIFYING = (
    "",
    " --plant new",
    " --renew 3650",
    " --revoke cstr/viewer",
    " --endpoint tls/localhost:1 --listen tls/x:1",
)


def content_of(site: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}


@pytest.mark.parametrize("seed", range(8))
def test_a_site_in_any_half_made_state_is_completed_or_refused_in_one_line(
    folder: Path, whole_site: Path, seed: int, monkeypatch: Patch, capsys: Shown
) -> None:
    """A refusal names the path and changes nothing; a second call changes nothing of what the first has completed."""
    choose, site = random.Random(seed), Path("site")
    for typed in CERTIFYING:
        shutil.copytree(whole_site, site)
        mangle(site, choose)
        before = content_of(site)
        code = run(["certify", "site", *typed.split()], monkeypatch)
        said = capsys.readouterr().err
        if code == 0:
            completed = content_of(site)
            assert run(["certify", "site"], monkeypatch) == 0
            assert content_of(site) == completed
        else:
            assert (code, said.count("\n")) == (2, 1), said
            assert "site/" in said or "--revoke cstr/viewer: is no" in said
            assert content_of(site) == before
        shutil.rmtree(site)
    assert not list((folder / "reports").iterdir())


@pytest.mark.usefixtures("no_router")
@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("alarm acknowledge shewhart/T --by \udcff", "'--by': must be UTF-8"),
        ("alarm shelve \udcff --by A --minutes 1", "must be UTF-8"),
        ("alarm comment shewhart/T --by A --comment \udcff", "'--comment': must be UTF-8"),
        *((f"{name} --timeout inf", "86400") for name in ("alarm list", "doctor", "status --check")),
        ("status --once --seconds 1e308", "86400"),
        ("demo --duration inf -o new", "duration_min must be above 0"),
        ("demo --seed -1 -o new", "seed must be in"),
        ("demo --site site -o new", "router settings"),
        ("up --config promise.toml -o new", "settings [monitor]: false_alarms_per_30_days must be in [0.048, "),
    ],
)
def test_the_line_names_the_rule(folder: Path, typed: str, said: str, monkeypatch: Patch, capsys: Shown) -> None:
    (folder / "promise.toml").write_text("[monitor]\nfalse_alarms_per_30_days = 0.01\n")
    assert run(typed.split(), monkeypatch) == 2
    assert said in capsys.readouterr().err
    assert not (folder / "new").exists()
