"""The lock file: every requirement of the image, one version each, with hashes and without an address of an index."""

import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[3]
LOCK = (ROOT / "deploy" / "requirements.lock").read_text(encoding="utf-8")
LINES = re.sub(r"^#.*\n", "", LOCK, flags=re.MULTILINE).replace(" \\\n", " ").splitlines()


@pytest.fixture(scope="module")
def lock() -> ModuleType:
    spec = importlib.util.spec_from_file_location("lock", ROOT / "deploy" / "lock.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_line_is_a_version_with_hashes_and_nothing_else() -> None:
    assert len(LINES) > 30
    for line in LINES:
        assert re.fullmatch(r"[a-z0-9-]+==[\w.]+( +--hash=sha256:[0-9a-f]{64})+", line)
    names = [line.split("==")[0] for line in LINES]
    assert names == sorted(set(names))


def test_every_requirement_of_the_image_is_locked_at_a_version_that_it_allows(lock: ModuleType) -> None:
    versions = dict(line.split()[0].split("==") for line in LINES)
    for text in lock.required(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))):
        required = Requirement(text)
        assert versions[required.name] in required.specifier, f"{text}: `make lock`"


def test_a_report_of_pip_becomes_lines_without_its_addresses(lock: ModuleType) -> None:
    def report(digest: str) -> dict[str, object]:
        info = {"url": "https://files.example/x.whl", "archive_info": {"hashes": {"sha256": digest}}}
        return {"install": [{"metadata": {"name": "Some_Name", "version": "1.2"}, "download_info": info}]}

    text = lock.text_of([lock.locked(report("b" * 64)), lock.locked(report("a" * 64))])
    assert text.splitlines()[2:] == [
        "some-name==1.2 \\",
        f"    --hash=sha256:{'a' * 64} \\",
        f"    --hash=sha256:{'b' * 64}",
    ]


def test_the_image_installs_what_is_locked_and_nothing_else() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    installs = [line for line in text.splitlines() if "pip install" in line]
    assert all(
        "--require-hashes" in line or ("--no-deps" in line and "--no-build-isolation" in line) for line in installs
    )
    assert len(installs) == 3
    assert re.search(r"^ARG PYTHON_IMAGE=python:\d+\.\d+\.\d+-", text, re.MULTILINE)
    assert "USER reactorwatch" in text


def test_the_image_holds_every_package_of_the_wheel() -> None:
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    copied = re.findall(r"^COPY (\w+) \./\1$", text, re.MULTILINE)
    assert sorted(copied) == sorted(wheel["wheel"]["packages"])


@pytest.mark.skipif(shutil.which("sed") is None, reason="needs sed")
def test_the_image_of_nodes_leaves_out_rerun_and_nothing_else() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    (script,) = re.findall(r"^RUN sed '([^']+)' requirements.lock > nodes.lock$", text, re.MULTILINE)
    left = subprocess.run(["sed", script], input=LOCK, capture_output=True, text=True, check=True).stdout
    lines = re.sub(r"^#.*\n", "", left, flags=re.MULTILINE).replace(" \\\n", " ").splitlines()
    assert lines == [line for line in LINES if not line.startswith("rerun-sdk==")]
    assert len(lines) == len(LINES) - 1


def test_nodes_run_without_rerun_and_a_dashboard_names_the_missing_package() -> None:
    program = (
        "import sys\n"
        "from importlib import machinery\n"
        "find = machinery.PathFinder.find_spec\n"
        "machinery.PathFinder.find_spec = lambda name, *rest: None if name.startswith('rerun') else find(name, *rest)\n"
        "import diagnosis_node.__main__, monitor_node.__main__\n"
        "import plant_node.__main__, recorder.__main__\n"
        "import reactorwatch.cli.diagnose\n"
        "try:\n"
        "    import recorder.view.file\n"
        "except ValueError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "dashboards need rerun-sdk, which is not installed here: pip install rerun-sdk\n"
