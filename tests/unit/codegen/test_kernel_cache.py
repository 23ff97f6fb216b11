"""The cache of kernels that Numba compiles."""

import subprocess
import sys
from pathlib import Path

KERNEL = """from reactorwatch.codegen.numba_kernel import jit
from names import double

@jit
def compute(value):
    return double(value) + 1.0

if __name__ == "__main__":
    import kernel
    print(kernel.compute(1.0))
"""
HELPER = """from reactorwatch.codegen.numba_kernel import jit

@jit
def double(value):
    return 2.0 * value
"""


def compute(folder: Path, module: str) -> str:
    """Result of the kernel with a helper in a module of this name."""
    (folder / f"{module}.py").write_text(HELPER, encoding="utf-8")
    (folder / "names.py").write_text(f"from {module} import double\n", encoding="utf-8")
    done = subprocess.run([sys.executable, "kernel.py"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_cache_that_names_a_module_of_another_version_is_made_again(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL, encoding="utf-8")
    assert compute(tmp_path, "before") == "3.0"
    (tmp_path / "before.py").unlink()
    assert compute(tmp_path, "after") == "3.0"
    assert list((tmp_path / "__pycache__").glob("kernel.compute*.nbi"))
