"""The diagnosis node as a process: `python -m diagnosis_node [settings.toml]`."""

import sys

from diagnosis_node.node import run
from diagnosis_node.trigger import DiagnosisConfig
from reactorwatch.runtime.node_main import main

if __name__ == "__main__":
    sys.exit(
        main(
            "diagnosis_node",
            "diagnosis",
            DiagnosisConfig,
            lambda config, bus_config, _metrics: run(config, bus_config),
        )
    )
