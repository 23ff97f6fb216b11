"""Compile all numerical kernels once: `python -m reactorwatch.codegen`."""

from reactorwatch.cli.main import run_command


def _run() -> int:
    from reactorwatch.cli.kernels import compile_kernels  # imports NumPy, which `run_command` prepares
    from reactorwatch.runtime.logs import configure

    configure()
    compile_kernels()
    return 0


if __name__ == "__main__":
    run_command(_run)
