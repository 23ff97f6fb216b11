"""The command line for users and scripts: help, one line for an error, a clean end on interrupt."""

import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import CommandReply, Health, InjectFault, SetInput
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from recorder.files.recording import Recording
from tests.tables import read_csv

from .conftest import PATIENCE_S, Command, Start, WaitAlive

COMMANDS = (
    *("up", "demo", "view", "alarm"),
    *("plant", "monitor", "record", "replay", "certify", "router", "doctor", "status"),
    *("dashboard", "import", "export", "recover", "info", "cut"),
    *("simulate", "backtest", "diagnose", "identify", "linearise", "charts"),
)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(called: Command, name: str) -> None:
    done = called(name, "--help")
    assert done.returncode == 0
    assert done.stdout.startswith(f"Usage: reactorwatch {name} ")


def test_help_lists_every_command_and_imports_nothing_slow() -> None:
    code = (
        "import sys; sys.argv = ['reactorwatch', '--help']\n"
        "from reactorwatch.cli.main import main\n"
        "try: main()\n"
        "finally: print(*sorted(set(sys.modules) & set(sys.argv[0:0] or "
        "['numpy', 'scipy', 'casadi', 'rerun', 'zenoh', 'numba', 'rich', 'structlog'])), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    listed = {line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ") and line.strip()}
    assert set(COMMANDS) <= listed
    assert done.stderr.strip() == ""


@pytest.fixture
def record_csv(tmp_path: Path) -> Path:
    path = tmp_path / "record.csv"
    path.write_text("time_min,qc,C,T\n0,100,0.1,440\n0.1,100,0.1,440\n0.2,100,0.1,440\n")
    return path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fly"], "No such command 'fly'"),
        (["replay"], "Missing argument"),
        (["backtest", "nowhere.csv"], "nowhere.csv: there is no such file"),
        (["backtest", "bad*.csv"], "bad*.csv: no file is called like this"),
        (["backtest", "EMPTY"], "holds no record (.csv) and no recording (.mcap)"),
        (["backtest", "RECORD", "--jobs", "0"], "Invalid value for '--jobs'"),
        (["backtest", "RECORD", "--scheduler", "here"], "--scheduler"),
        (["import", ".", "-o", "a.mcap"], "is a folder"),
        (["recover", "BAD.mcap"], "BAD.mcap: expected an MCAP recording, got another kind of file"),
        (["recover", "BAD.mcap", "-o", "no/such/a.mcap"], "folder"),
        (["info", "BAD.mcap"], "expected an MCAP recording, got another kind of file"),
        (["cut", "BAD.mcap", "--from", "soon", "-o", "a.mcap"], "--from must be a number with s, min or h"),
        (["cut", "BAD.mcap", "--from", "2min", "--to", "60s", "-o", "a.mcap"], "--from must be before --to"),
        (["backtest", "BAD.doc"], "must be a .csv or .mcap file"),
        (["backtest", "BAD.csv"], "row 3"),
        (["backtest", "BAD.mcap"], "BAD.mcap"),
        (["simulate", "RECORD", "-o", "no/such/folder.csv"], "folder"),
        (["simulate", "RECORD", "-o", "OUT", "--fault", "coolant:step:1@1min"], "unknown cause 'coolant'"),
        (
            ["simulate", "RECORD", "-o", "OUT", "--fault", "coolant_flow:step:-3@1min"],
            "size must be in [-0.99, 4], got -3",
        ),
        (["simulate", "RECORD", "-o", "OUT", "--column", "T"], "--column must be signal=column"),
        (["backtest", "RECORD", "--training", "0"], "training_min must be in"),
        (["plant", "--speed", "fast"], "--speed must be a positive number or 'max'"),
        (["plant", "--plant", "a/b"], "plant name must be"),
        (["plant", "--scenario", "storm"], "storm"),
        (["plant", "--endpoint", "nowhere"], "endpoint must be like"),
        (["monitor", "--config", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["dashboard", "RECORD", "-o", "no/such/a.rrd"], "folder"),
        (["dashboard", "RECORD", "-o", "OUT"], "must end in .rrd, got .csv"),
        (["dashboard", "RECORD", "-o", "a.rrd", "--diagnosis", "no"], "--diagnosis no: holds no report.rrd"),
        (["view", "--web", "--bind", "here"], "--bind must be an IP address of this machine"),
        (["view", "--web", "--bind", "192.0.2.1"], "is it one of this machine?"),
        (["view", "--config", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["import", "RECORD", "-o", "no/such/a.mcap"], "folder"),
        (["demo", "--fault", "nothing"], "nothing"),
        (["identify", "RECORD", "--process", "cstr", "--output", "pH"], "unknown --output 'pH' (valid: C, T)"),
        (["identify", "RECORD", "--output", "pH"], "expected a column 'pH'"),
        (["identify", "RECORD", "--model", "fir"], "unknown model 'fir' (valid: arx, oe, armax, bj, narx, noe)"),
        (["linearise", "900"], "qc must be in [0, 500]"),
        (["diagnose"], "Missing argument"),
        (["diagnose", "nowhere.csv", "-o", "out"], "nowhere.csv: there is no such file"),
        (["diagnose", "BAD.csv", "-o", "out"], "row 3"),
        (["diagnose", "RECORD", "--tolerance", "C"], "--tolerance must be output=number"),
        (["diagnose", "RECORD", "--uncertain", "K3=2"], "uncertain K3 must be in % or in l/min, got '2'"),
        (["diagnose", "RECORD", "--model", "BAD.csv"], "unknown process 'BAD.csv'"),
        (["diagnose", "RECORD", "-o", "BAD.txt"], "is a file, the name of a folder was expected"),
        (["simulate", "RECORD", "-o", "OUT", "--model", "nowhere.json"], "nowhere.json: there is no such file"),
        (["plant", "--model", "nowhere.json"], "nowhere.json: there is no such file"),
        (["monitor", "--model", "BAD.json"], "process file BAD.json: is not JSON"),
    ],
)
def test_an_error_is_reported_in_one_line_and_nothing_is_written(
    called: Command, tmp_path: Path, record_csv: Path, arguments: list[str], expected: str
) -> None:
    check_one_line_error(called, tmp_path, record_csv, arguments, expected)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [(["identify", "RECORD"], "rows"), (["diagnose", "RECORD", "-o", "out"], "needs at least 200 rows, got 3")],
)
def test_a_record_that_holds_too_little_is_reported_in_one_line_and_nothing_is_written(
    called: Command, tmp_path: Path, record_csv: Path, arguments: list[str], expected: str
) -> None:
    check_one_line_error(called, tmp_path, record_csv, arguments, expected, code=3)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fly"], "No such command 'fly'"),
        (["monitor", "--config", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
    ids=["before a command is known", "of a node"],
)
def test_a_process_of_its_own_reports_the_same_error(
    command: Command, tmp_path: Path, record_csv: Path, arguments: list[str], expected: str
) -> None:
    check_one_line_error(command, tmp_path, record_csv, arguments, expected)


def check_one_line_error(
    command: Command, tmp_path: Path, record_csv: Path, arguments: list[str], expected: str, code: int = 2
) -> None:
    (tmp_path / "BAD.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n0.1,100,x,440\n")
    (tmp_path / "BAD.mcap").write_bytes(b"this is no recording")
    (tmp_path / "BAD.txt").write_text("?")
    (tmp_path / "BAD.json").write_text("?")
    (tmp_path / "BAD.doc").write_text("?")
    (tmp_path / "EMPTY").mkdir()
    before = sorted(tmp_path.rglob("*"))
    named = [{"RECORD": str(record_csv), "OUT": str(tmp_path / "out.csv")}.get(item, item) for item in arguments]
    done = command(*named, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert expected in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stderr.startswith("reactorwatch: ")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_node_without_a_router_waits_reports_it_and_can_be_stopped(endpoint: str, start: Start) -> None:
    process = start("monitor", "--endpoint", endpoint)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert "waiting for a router" in line
    assert endpoint in line
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0


def test_up_runs_until_ctrl_c_and_closes_its_files(endpoint: str, start: Start, tmp_path: Path) -> None:
    """`test_secured.py` ends it by SIGTERM."""
    folder = tmp_path / "runs"
    process = start("up", "--endpoint", endpoint, "--out", folder, "--speed", "60", "--plant", "R-101")
    listener = connect(BusConfig(endpoint=endpoint), "test", StopSignal())
    assert listener is not None
    sampled = threading.Event()
    listener.subscribe(keys.all_keys("R-101", keys.SAMPLE), lambda _message: sampled.set())
    assert sampled.wait(PATIENCE_S)
    listener.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 0
    (recording,) = folder.glob("*.mcap")
    assert recording.name.startswith("R-101-")
    assert not list(folder.glob("*.part"))
    kinds = {entry.key.split("/")[2] for entry in Recording(recording).messages()}
    assert {"sample", "health"} <= kinds


def test_the_plant_obeys_commands_on_the_bus(bus: ZenohBus, endpoint: str, start: Start, wait_alive: WaitAlive) -> None:
    process = start("plant", "--endpoint", endpoint, "--speed", "600")
    wait_alive("cstr", "plant")

    def ask(name: str, message: SetInput | InjectFault) -> CommandReply:
        question = Encoded(keys.key("cstr", keys.COMMAND, name), *encode_message(message))
        (answer,) = bus.query(question, PATIENCE_S)
        return CommandReply.FromString(answer.payload)

    assert ask("set_input", SetInput(signal="qc", value=95.0)).accepted
    refused = ask("set_input", SetInput(signal="qc", value=-5.0))
    assert not refused.accepted
    assert "-5" in refused.text
    assert ask("inject_fault", InjectFault(specification="coolant_flow:step:-0.05")).accepted
    assert not ask("inject_fault", InjectFault(specification="magic:step:1")).accepted
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 0


def test_a_node_that_is_not_there_is_not_alive(bus: ZenohBus, endpoint: str, called: Command) -> None:
    nothing = called("status", "--check", "--endpoint", endpoint, "--timeout", "1")
    assert (nothing.returncode, nothing.stdout) == (1, "no node of plant 'cstr' published its health within 1 s\n")
    health = Health(time_ns=1, node="monitor", phase="watching")
    bus.publish(encode(Publication(keys.key("cstr", keys.HEALTH, "monitor"), health)))
    dead = called("status", "--check", "--endpoint", endpoint, "--timeout", "1")
    assert (dead.returncode, dead.stdout) == (1, "monitor is not there within 1 s\n")
    bus.declare_token(keys.key("cstr", keys.ALIVE, "monitor"))
    there = called("status", "--check", "monitor", "--endpoint", endpoint)
    all_there = called("status", "--check", "--endpoint", endpoint)
    assert [(item.returncode, item.stdout) for item in (there, all_there)] == 2 * [(0, "monitor is alive\n")]
    bus.undeclare_token(keys.key("cstr", keys.ALIVE, "monitor"))
    gone = called("status", "--check", "monitor", "--endpoint", endpoint, "--timeout", "1", "--json")
    assert gone.returncode == 1
    assert json.loads(gone.stdout) == {"plant": "cstr", "nodes": [{"node": "monitor", "alive": False}]}


def test_a_shard_is_alive_as_long_as_a_monitor_of_it_in_any_fleet_is(
    bus: ZenohBus, endpoint: str, called: Command
) -> None:
    def check(*nodes: str) -> tuple[int, list[list[str | bool]]]:
        done = called("status", "--check", *nodes, "--endpoint", endpoint, "--timeout", "1", "--json")
        return done.returncode, [list(node.values()) for node in json.loads(done.stdout)["nodes"]]

    north, all_plants = (keys.fleet_token(plants, "5", "2", "a.1@pi4") for plants in ("reactor/north_*", "reactor/*"))
    for token in (north, all_plants, keys.key("cstr", keys.ALIVE, "recorder")):
        bus.declare_token(token)
    assert check("2/5") == (0, [["2/5", True]])
    assert check("2/5", "recorder") == (0, [["2/5", True], ["recorder", True]])
    assert check("3/5", "02/05", "2/6") == (1, [["3/5", False], ["2/5", True], ["2/6", False]])
    bus.undeclare_token(north)
    assert check("2/5") == (0, [["2/5", True]])
    bus.undeclare_token(all_plants)
    assert check("2/5") == (1, [["2/5", False]])


@pytest.mark.parametrize("shard", ["6/5", "0/5", "2/", "a/b", "1/1001", "²/5"])
def test_a_malformed_shard_is_refused_in_one_line(shard: str, called: Command) -> None:
    done = called("status", "--check", shard)
    assert done.returncode == 2
    assert f"shard must be like 2/5, the second of five, with at most 1000, got {shard!r}\n" in done.stderr
    assert done.stderr.count("\n") == 1


def test_simulate_and_backtest_speak_json_to_machines(called: Command, record_csv: Path, tmp_path: Path) -> None:
    simulated = called("simulate", record_csv, "-o", tmp_path / "out.csv", "--json")
    assert simulated.returncode == 0, simulated.stderr
    assert set(json.loads(simulated.stdout)["rmse"]) == {"C", "T"}
    assert read_csv(tmp_path / "out.csv").rows == 3
    tested = called("backtest", record_csv, "--json")
    assert tested.returncode == 3, tested.stderr  # all of it went into the training
    said = json.loads(tested.stdout)
    assert said.pop("why") in tested.stderr
    assert said == {
        "watched": False,
        "samples": 3, "zero": None, "span_min": 0.2, "runs": 1, "trained_until_min": None, "expected_false_alarms": 0.0,
        "signals": {"inputs": ["qc"], "outputs": ["C", "T"], "left_out": []},
        "reference": None, "noise_levels": None, "baseline": None, "alarms": [], "promise": None, "power": [],
    }  # fmt: skip
