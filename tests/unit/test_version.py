"""The version is stated in one place, and each build states the commit that it was made from, or that it is unknown."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

import reactorwatch
from reactorwatch.cli.main import main
from reactorwatch.version import COMMIT, UNKNOWN, describe_build, find_commit, this_build, version
from tests.manifests import pod, workloads

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NUMBER = PYPROJECT["project"]["version"]
ARGUMENT = "0123456789abcdef0123456789abcdef01234567"
"""The build argument."""

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="needs git")


def test_the_installed_version_is_the_number_in_pyproject() -> None:
    """After a change of the number, `make setup` installs it."""
    assert importlib.metadata.version("reactorwatch") == NUMBER
    assert version() == reactorwatch.__version__ == NUMBER


def test_the_number_is_repeated_in_no_module() -> None:
    packages = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    modules = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    assert [str(path) for path in modules if NUMBER in path.read_text(encoding="utf-8")] == []


def test_the_citation_and_the_images_of_containers_and_pods_have_the_version() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == NUMBER
    for item in workloads(ROOT / "deploy" / "kubernetes").values():
        images = {one["image"] for one in (*pod(item).get("initContainers", []), *pod(item)["containers"])}
        assert images in ({f"reactorwatch:{NUMBER}"}, {"eclipse/zenoh:1.10.2"}), item["metadata"]["name"]
    for file in (ROOT / "docker-compose.yml", *(ROOT / "deploy").glob("docker-compose.*.yml")):
        services = yaml.safe_load(file.read_text(encoding="utf-8"))["services"]
        own = {item["image"] for name, item in services.items() if name != "router"}
        assert own == {f"reactorwatch:{NUMBER}"}, file.name
        (build,) = [item["build"] for item in services.values() if "build" in item]
        assert build["args"] == {"COMMIT": "${COMMIT:-unknown}"}, file.name


def test_the_image_is_built_with_the_commit_as_an_argument() -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    (copied,) = re.findall(r"^COPY (pyproject\.toml .*) \./$", text, re.MULTILINE)
    assert "hatch_build.py" in copied.split()
    assert re.search(r"^ARG COMMIT=unknown\nRUN COMMIT=\$\{COMMIT\} pip install .* \.$", text, re.MULTILINE)


def test_the_option_version_prints_version_and_commit(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert capsys.readouterr().out == f"reactorwatch {this_build()}\n"
    assert re.fullmatch(rf"{re.escape(NUMBER)} \(commit ({COMMIT}|{UNKNOWN})\)", this_build())


def test_a_version_without_commit_is_stated_as_unknown() -> None:
    assert describe_build("1.0", UNKNOWN) == "1.0 (commit unknown)"


# --- trees that are built -------------------------------------------------------------------------------------------


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=Test", "-c", "user.email=test@example.org", "-c", "commit.gpgsign=false"]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    done = subprocess.run(["git", *who, *arguments], cwd=folder, env=clean, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def bare_tree(folder: Path) -> Path:
    """A tree with all that the build needs, and no git."""
    for package in PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        (folder / package).mkdir(parents=True)
        (folder / package / "__init__.py").touch()
    for name in ("pyproject.toml", "hatch_build.py", ".gitignore", "README.md", "LICENSE", "reactorwatch/version.py"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def cloned(folder: Path) -> Path:
    tree = bare_tree(folder)
    git(tree, "init", "--quiet", "--initial-branch=main")
    git(tree, "add", ".")
    for text in ("first", "second"):
        git(tree, "commit", "--quiet", "--allow-empty", "--message", text)
    return tree


def shallow(folder: Path) -> Path:
    source = cloned(folder.with_name("source"))
    git(folder.parent, "clone", "--quiet", "--depth=1", source.as_uri(), str(folder))
    return folder


def detached(folder: Path) -> Path:
    tree = cloned(folder)
    git(tree, "checkout", "--quiet", "--detach", "HEAD~1")
    return tree


def packed(folder: Path) -> Path:
    tree = cloned(folder)
    git(tree, "checkout", "--quiet", "-b", "topic/one")
    git(tree, "pack-refs", "--all")
    return tree


def linked(folder: Path) -> Path:
    git(cloned(folder.with_name("source")), "worktree", "add", "--quiet", "-b", "topic/two", str(folder))
    git(folder, "commit", "--quiet", "--allow-empty", "--message", "of its own")
    return folder


def linked_and_packed(folder: Path) -> Path:
    tree = linked(folder)
    git(tree, "pack-refs", "--all")
    return tree


def submodule(folder: Path) -> Path:
    source, above = cloned(folder.with_name("source")), folder.with_name("above")
    above.mkdir()
    git(above, "init", "--quiet")
    git(above, "-c", "protocol.file.allow=always", "submodule", "--quiet", "add", source.as_uri(), "part")
    return above / "part"


WITH_GIT = [cloned, shallow, detached, packed, linked, linked_and_packed, submodule]
Kind = Callable[[Path], Path]


def build(tree: Path, target: str, out: Path, commit: str | None) -> Path:
    """Build as pip does, without an index."""
    environment = {name: value for name, value in os.environ.items() if name != "COMMIT"}
    if commit is not None:
        environment["COMMIT"] = commit
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(out)]
    done = subprocess.run(command, cwd=tree, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl" if target == "wheel" else "*.tar.gz")
    return built


def stated_by_wheel(tree: Path, out: Path, commit: str | None = None) -> str:
    """Commit that the software in a wheel states."""
    with zipfile.ZipFile(build(tree, "wheel", out, commit)) as wheel:
        wheel.extractall(out / "installed")
    return find_commit(out / "installed" / "reactorwatch")


@needs_git
@pytest.mark.parametrize("kind", WITH_GIT)
def test_a_work_tree_s_commit_is_that_which_git_names_built_or_not(kind: Kind, tmp_path: Path) -> None:
    tree = kind(tmp_path / "tree")
    expected = git(tree, "rev-parse", "HEAD")
    assert re.fullmatch(COMMIT, expected)
    assert find_commit(tree / "reactorwatch") == expected
    assert stated_by_wheel(tree, tmp_path / "out", ARGUMENT) == expected
    assert git(tree, "status", "--porcelain") == ""  # a file in the tree would be stale after the next commit


@needs_git
def test_a_work_tree_states_the_next_commit_after_it(tmp_path: Path) -> None:
    tree = cloned(tmp_path / "tree")
    before = find_commit(tree / "reactorwatch")
    stated_by_wheel(tree, tmp_path / "out")
    git(tree, "commit", "--quiet", "--allow-empty", "--message", "third")
    assert find_commit(tree / "reactorwatch") == git(tree, "rev-parse", "HEAD") != before


@pytest.mark.parametrize(("argument", "expected"), [(ARGUMENT, ARGUMENT), (UNKNOWN, UNKNOWN), (None, UNKNOWN)])
def test_a_tree_without_git_is_built_and_states_the_argument_or_unknown(
    argument: str | None, expected: str, tmp_path: Path
) -> None:
    assert stated_by_wheel(bare_tree(tmp_path / "tree"), tmp_path / "out", argument) == expected


def test_a_commit_that_is_none_ends_the_build(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"COMMIT must be 7 to 64 hexadecimal digits.*got 'v1'"):
        stated_by_wheel(bare_tree(tmp_path / "tree"), tmp_path / "out", "v1")


@needs_git
def test_a_wheel_from_a_source_distribution_states_the_commit_of_the_distribution(tmp_path: Path) -> None:
    tree = cloned(tmp_path / "tree")
    with tarfile.open(build(tree, "sdist", tmp_path / "out", None)) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert stated_by_wheel(unpacked, tmp_path / "out") == git(tree, "rev-parse", "HEAD")


@needs_git
def test_a_wheel_installed_into_another_project_s_work_tree_states_its_own_commit(tmp_path: Path) -> None:
    wheel = build(bare_tree(tmp_path / "tree"), "wheel", tmp_path / "out", ARGUMENT)
    other = cloned(tmp_path / "other")
    shutil.rmtree(other / "reactorwatch")
    with zipfile.ZipFile(wheel) as opened:
        opened.extractall(other)
    assert find_commit(other / "reactorwatch") == ARGUMENT


@pytest.mark.parametrize("head", ["", "ref: refs/heads/.invalid", "ref: refs/heads/gone", "\xff", "not a commit"])
def test_a_head_that_cannot_be_read_is_unknown(head: str, tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git" / "HEAD").write_text(head, encoding="latin-1")
    assert find_commit(tmp_path / "reactorwatch") == UNKNOWN
