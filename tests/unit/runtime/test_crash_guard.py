"""The crash guard: every module that runs as a process ends an unexpected error in one line and with its code."""

import errno
import re
import runpy
import sys
import tempfile
from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.runtime.node_main import EXIT_CODE, print_error

ROOT = Path(__file__).parents[3]
PACKAGES = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node")
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)
ARGUMENTS = {
    "reactorwatch": ["record"],
    "diagnosis_node": ["settings.toml"],
    "recorder.tools.replay": ["settings.toml"],
}
ERRORS: dict[str, tuple[BaseException, int, str | None]] = {
    "a fault of ours": (
        RuntimeError("the wrong\nreactor\x1b[31m"),
        EXIT_CODE,
        r"the wrong reactor.*please send (\S+),",
    ),
    "a full disk": (OSError(errno.ENOSPC, "no room", "x.mcap"), 2, r"x\.mcap: no room$"),
    "an unusable setting": (InputError("no such\nreactor"), 2, r"no such reactor$"),
    "Ctrl-C": (KeyboardInterrupt(), 130, None),
}


def test_the_modules_are_those_that_the_documents_name() -> None:
    assert MODULES == [
        "diagnosis_node",
        "monitor_node",
        "plant_node",
        "reactorwatch",
        "reactorwatch.codegen",
        "recorder",
        "recorder.tools.replay",
    ]


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("module", MODULES)
def test_an_error_within_a_node_process_is_one_line(
    module: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raised, code, line = ERRORS[error]

    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.connect", fail)
    monkeypatch.setattr("reactorwatch.cli.kernels.compile_kernels", fail)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    Path("settings.toml").write_text('[diagnosis]\nout = "reports"\n[replay]\nfile = "run.csv"\n')
    Path("run.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n1,101,0.1,440\n")
    monkeypatch.setattr(sys, "argv", [module, *ARGUMENTS.get(module, [])])
    for name in (module, f"{module}.__main__"):  # as in a process of its own, in which nothing has imported it
        if not hasattr(sys.modules.get(name), "__path__"):
            monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(module, run_name="__main__", alter_sys=False)
    assert ended.value.code == code
    *_, said = ["", *capsys.readouterr().err.splitlines()]
    if line is None:
        assert "Traceback" not in said
        return
    found = re.search(line, said)
    assert found is not None, said
    if code == EXIT_CODE:
        assert "\x1b" not in said
        assert "Traceback (most recent call last)" in Path(found[1]).read_text(encoding="utf-8")


def test_a_complaint_is_one_line_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    print_error("recorder", "a\nb\x1b[31m\udcff")
    assert capsys.readouterr().err == "recorder: a b\\u001b[31m\\udcff\n"
