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


def start(unit: str, instance: str) -> list[str]:
    """The command of an instance of a unit, after the program."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.read(UNITS / unit)
    node = instance.removesuffix(".service").partition("@")[2]
    program, *arguments = parser["Service"]["ExecStart"].replace("%i", node).split()
    assert program == INSTALLED
    return arguments


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, *NODES])
def test_systemd_accepts_the_unit(tmp_path: Path, unit: str, instance: str) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed")
    text = (UNITS / unit).read_text(encoding="utf-8")
    assert INSTALLED in text
    (tmp_path / instance).write_text(text.replace(INSTALLED, REACTORWATCH), encoding="utf-8")
    command = [program, "verify", "--man=no", "--recursive-errors=no", str(tmp_path / instance)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("unit", "instance"), [ROUTER, *NODES])
def test_a_unit_without_its_settings_ends_with_the_code_that_stops_trying(unit: str, instance: str) -> None:
    arguments = start(unit, instance)
    assert not Path(arguments[-1]).exists(), "this machine has a site; the test would join it"
    done = subprocess.run([REACTORWATCH, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert arguments[-1] in done.stderr
    assert "RestartPreventExitStatus=2" in (UNITS / unit).read_text(encoding="utf-8")


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
