"""Write deploy/requirements.lock: what the image installs, each with its version and the hashes of its files.

    python deploy/lock.py

pip resolves what pyproject.toml asks for, for the Python and the platforms of the image, without installing anything. A
version that the first platform gets is asked for on the others. The file is in pip's requirements form and holds no
address of an index, so any index with the same files serves (`pip install --require-hashes`).
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "deploy" / "requirements.lock"
PYTHON = "3.13"
EXTRAS = ("metrics",)
MACHINES = ("x86_64", "aarch64")
GLIBC_MINORS = range(41, 16, -1)  # of manylinux tags that python:3.13-slim, which has glibc 2.41, takes

Locked = dict[str, tuple[str, frozenset[str]]]
"""Version and hashes, by the name of a distribution."""


def required(pyproject: Mapping[str, Any]) -> list[str]:
    """The requirements of the image, with what builds the package in it."""
    project = pyproject["project"]
    found = [*pyproject["build-system"]["requires"], *project["dependencies"]]
    for extra in EXTRAS:
        found += project["optional-dependencies"][extra]
    return found


def resolve(requirements: Sequence[str], machine: str) -> Locked:
    """Have pip resolve requirements for a machine."""
    tags = [f"manylinux_2_{minor}_{machine}" for minor in GLIBC_MINORS] + [f"manylinux2014_{machine}"]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        asked = Path(folder) / "requirements.txt"
        asked.write_text("\n".join(requirements), encoding="utf-8")
        subprocess.run(  # noqa: S603 (our own words)
            [
                *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"),
                *("--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}"),
                *(f"--abi={abi}" for abi in (f"cp{PYTHON.replace('.', '')}", "abi3", "none")),
                *(f"--platform={tag}" for tag in tags),
                *("--target", str(Path(folder) / "nothing"), "--report", str(report), "--requirement", str(asked)),
            ],
            check=True,
        )
        return locked(json.loads(report.read_text(encoding="utf-8")))


def locked(report: Mapping[str, Any]) -> Locked:
    """Version and hashes of each distribution of pip's report."""
    return {
        item["metadata"]["name"].lower().replace("_", "-"): (
            item["metadata"]["version"],
            frozenset({item["download_info"]["archive_info"]["hashes"]["sha256"]}),
        )
        for item in report["install"]
    }


def text_of(found: Sequence[Locked]) -> str:
    """The lock file of several machines."""
    lines = [
        "# Made by `make lock`: what the image installs, for " + " and ".join(MACHINES) + f" and Python {PYTHON}.",
        "# `pip install --require-hashes -r deploy/requirements.lock` takes nothing else.",
    ]
    for name in sorted({name for machine in found for name in machine}):
        of_name = [machine[name] for machine in found if name in machine]
        hashes = sorted(frozenset().union(*(item[1] for item in of_name)))
        lines += [f"{name}=={of_name[0][0]} \\", *(f"    --hash=sha256:{digest} \\" for digest in hashes)]
        lines[-1] = lines[-1].removesuffix(" \\")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the file."""
    requirements = required(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8")))
    first = resolve(requirements, MACHINES[0])
    same = [*requirements, *(f"{name}=={version}" for name, (version, _) in first.items())]
    LOCK.write_text(text_of([first, *(resolve(same, machine) for machine in MACHINES[1:])]), encoding="utf-8")


if __name__ == "__main__":
    main()
