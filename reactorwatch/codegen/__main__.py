"""Compile all numerical kernels once: `python -m reactorwatch.codegen`."""

from reactorwatch.cli.main import run_command


def _run() -> int:
    from reactorwatch.cli.kernels import compile_kernels  # imports NumPy, which `run_command` prepares
    from reactorwatch.runtime.node_main import configure_log

    configure_log()
    compile_kernels()
    return 0


if __name__ == "__main__":
    run_command(_run)
