"""Compile all numerical kernels once: `python -m reactorwatch.codegen`."""

from reactorwatch.cli.kernels import compile_kernels
from reactorwatch.cli.main import run_command
from reactorwatch.runtime.logs import configure


def _run() -> int:
    configure()
    compile_kernels()
    return 0


if __name__ == "__main__":
    run_command(_run)
