"""The units for systemd, as its own checker reads them, and by what they run."""

import configparser
import shutil
import subprocess
from pathlib import Path

import pytest

from ..end_to_end.conftest import REACTORWATCH

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
INSTALLED = "/opt/reactorwatch/bin/reactorwatch"
ROUTER = ("reactorwatch-router.service", "reactorwatch-router.service")
NODES = tuple(("reactorwatch@.service", f"reactorwatch@{node}.service") for node in ("plant", "monitor", "record"))
SHARD = ("reactorwatch-shard@.service", "reactorwatch-shard@2.service")


def files(unit: str) -> list[Path]:
    """The unit and what is dropped into it; the unit of a shard is a copy of the node's."""
    return [UNITS / unit.replace("-shard", ""), *(UNITS / f"{unit}.d").glob("*.conf")]


def parse(*paths: Path) -> configparser.SectionProxy:
    """Settings of the service; of those that are given several times the last."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign] # keys as they are
    parser.read(paths)
    return parser["Service"]


def start(unit: str, instance: str) -> list[str]:
    """The command of an instance of a unit, after the program."""
    service = parse(*files(unit))
    command, count = service["ExecStart"], service.get("Environment", "").partition("SHARDS=")[2]
    for name, value in {"%i": instance[instance.find("@") + 1 : -len(".service")], "${SHARDS}": count}.items():
        command = command.replace(name, value)
    program, *arguments = command.split()
    assert program == INSTALLED
    return arguments


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, *NODES, SHARD])
def test_systemd_accepts_the_unit(tmp_path: Path, unit: str, instance: str) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    (tmp_path / f"{instance}.d").mkdir()
    for file, name in zip(files(unit), (instance, f"{instance}.d/shard.conf"), strict=False):
        text = file.read_text(encoding="utf-8")
        assert INSTALLED in text
        (tmp_path / name).write_text(text.replace(INSTALLED, REACTORWATCH), encoding="utf-8")
    command = [program, "verify", "--man=no", "--recursive-errors=no", str(tmp_path / instance)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, *NODES, SHARD])
def test_a_unit_without_its_settings_ends_with_the_code_that_stops_trying(unit: str, instance: str) -> None:
    arguments = start(unit, instance)
    settings = next(word for word in arguments if word.startswith("/etc/reactorwatch/"))
    assert not Path(settings).exists(), "this machine has a site; the test would join it"
    done = subprocess.run([REACTORWATCH, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert settings in done.stderr
    assert "RestartPreventExitStatus=2" in files(unit)[0].read_text(encoding="utf-8")


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, NODES[0]])
def test_a_unit_is_exposed_by_3_of_10_at_most(unit: str, instance: str) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    command = [program, "security", "--offline=true", "--no-pager", "--threshold=30", str(UNITS / unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze knows no --offline")
    assert done.returncode == 0, f"{instance}: {done.stdout}{done.stderr}"


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, NODES[0]])
def test_a_unit_has_limits_and_no_capability(unit: str, instance: str) -> None:
    """What the checker counts, and what it does not, also where there is no checker."""
    settings = (UNITS / unit).read_text(encoding="utf-8").split("[Service]")[1].splitlines()
    for line in (
        *("NoNewPrivileges=yes", "CapabilityBoundingSet=", "ProtectSystem=strict", "RestrictNamespaces=yes"),
        *("SystemCallFilter=@system-service", "PrivateUsers=yes", "ProtectKernelModules=yes"),
    ):
        assert line in settings, instance
    assert any(line.startswith("MemoryMax=") for line in settings)


def test_a_shard_is_the_node_s_unit_with_a_command_and_a_folder_of_its_own() -> None:
    """So its protection is that of the node. A link would be an alias, and the drop-in would change the node, too."""
    unit, dropped = files(SHARD[0])
    assert unit == UNITS / NODES[0][0]
    assert not (UNITS / SHARD[0]).exists()
    assert set(parse(dropped)) == {"Environment", "StateDirectory", "WorkingDirectory", "ExecStart"}
    arguments = start(*SHARD)
    assert (arguments[0], arguments[arguments.index("--shard") + 1]) == ("monitor", "2/5")
    assert arguments[-2:] == ["--state", "%S/reactorwatch/monitor-2"]
    assert parse(dropped)["StateDirectory"] == "reactorwatch/monitor-%i"
