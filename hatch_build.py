"""Build hook: a wheel and a source distribution hold the commit that they were made from.

It is that of the git work tree, where there is one; else the build argument, which is the environment variable COMMIT;
else the one that a source distribution holds; else unknown. An editable install holds none: the work tree is read when
the software runs.
"""

import os
import re
import runpy
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "reactorwatch"


class CommitHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds a file with the commit to what is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file, and name it to the builder."""
        if version == "editable":
            return
        root = Path(self.root)
        module = runpy.run_path(str(root / PACKAGE / "version.py"))
        stated, unknown = root / PACKAGE / module["COMMIT_FILE"], module["UNKNOWN"]
        commit = module["head_commit"](root) or os.environ.get("COMMIT")
        if commit is None:
            commit = stated.read_text(encoding="ascii").strip() if stated.is_file() else unknown
        if not re.fullmatch(f"{module['COMMIT']}|{unknown}", commit):
            raise ValueError(f"COMMIT must be 7 to 64 hexadecimal digits in lower case, or {unknown}, got {commit!r}")
        self._folder = tempfile.TemporaryDirectory()  # not in the tree, where a later commit would find it
        file = Path(self._folder.name, stated.name)
        file.write_text(f"{commit}\n", encoding="ascii")
        build_data["force_include"][str(file)] = f"{PACKAGE}/{stated.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file, which the artifact holds now."""
        if version != "editable":
            self._folder.cleanup()
