"""Build of this software: its version, and the commit that it was made from.

The version is that of the installed distribution, whose number stands in `pyproject.toml` and nowhere else. The commit
is in a file that `hatch_build.py` adds to a wheel; a git work tree has none, and its commit is that of `HEAD`.
"""

import re
from contextlib import suppress
from functools import cache
from pathlib import Path

COMMIT_FILE = "COMMIT"
"""Name of the file in this folder."""

UNKNOWN = "unknown"
COMMIT = "[0-9a-f]{7,64}"
"""Pattern of a commit."""

_PACKAGE = Path(__file__).parent


@cache
def version() -> str:
    """Version of the installed distribution; unknown if the package is used without one."""
    from importlib.metadata import PackageNotFoundError, version  # 30 ms, which no help text needs

    try:
        return version("reactorwatch")
    except PackageNotFoundError:
        return UNKNOWN


@cache
def commit() -> str:
    """Commit of this build as hexadecimal digits, or unknown; it is read once, whatever is checked out later."""
    return find_commit(_PACKAGE)


def build_metadata() -> dict[str, str]:
    """Version and commit, as recordings hold them."""
    return {"version": version(), "commit": commit()}


def describe_build(version: str, commit: str) -> str:
    """Text for people.

    >>> describe_build("1.2.0", "0123456789abcdef0123456789abcdef01234567")
    '1.2.0 (commit 0123456789ab)'
    """
    return f"{version} (commit {commit[:12]})"  # tells the commits of the largest public repositories apart


def this_build() -> str:
    """Text for people about this build."""
    return describe_build(version(), commit())


def find_commit(package: Path) -> str:
    """Commit that the file in a package's folder states, else that of the git work tree around it; or unknown."""
    with suppress(OSError, UnicodeDecodeError):
        stated = package / COMMIT_FILE
        found = stated.read_text(encoding="ascii").strip() if stated.is_file() else head_commit(package.parent)
        if re.fullmatch(COMMIT, found):
            return found
    return UNKNOWN


def head_commit(tree: Path) -> str:
    """Commit of `HEAD` of the git work tree whose top is a folder; empty if it is none.

    The files are read, as git documents them (gitrepository-layout): an image or a service may lack the program.
    """
    git = tree / ".git"
    if git.is_file():  # a linked work tree, or a submodule
        git = tree / git.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
    if not (git / "HEAD").is_file():
        return ""
    head = (git / "HEAD").read_text(encoding="utf-8").strip()
    if not head.startswith("ref:"):
        return head
    name, shared = head.removeprefix("ref:").strip(), git / "commondir"
    common = git / shared.read_text(encoding="utf-8").strip() if shared.is_file() else git
    for loose in (git / name, common / name):
        if loose.is_file():
            return loose.read_text(encoding="ascii").strip()
    packed = common / "packed-refs"
    lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
    return next((line.partition(" ")[0] for line in lines if line.endswith(f" {name}")), "")
