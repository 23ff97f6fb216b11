"""`compile`: compile all numerical kernels ahead of their first call.

Kernels are compiled at their first call and cached on disk (`reactorwatch.codegen.numba_kernel`,
`codegen.compiled_function`). On a new machine that call interrupts a monitor or a diagnosis, for half a minute in all.
So all kernels run here once, over a short simulated record: by `make setup`, by the images, or by hand.
"""

ROWS = 600
"""Rows of the record: enough for a diagnosis, and for a fault after the monitor's training."""

FAULT = "coolant_flow:step:-0.1@30min"
TRAINING_MIN = 15.0


def compile_kernels() -> None:
    """Compile the numerical kernels once, so that no first start has to: half a minute on a new machine."""
    from monitor_node.config import MonitorConfig
    from monitor_node.fleet.monitor import ANY, PlantKind, prepare
    from monitor_node.replay import backtest
    from plant_node.config import PlantConfig
    from plant_node.record import simulate_record
    from reactorwatch.cli.progress import task
    from reactorwatch.contract.codec import encode
    from reactorwatch.diagnosis.diagnose import diagnose
    from reactorwatch.process.library.cstr import cstr
    from recorder.tools.player import samples_of

    record = simulate_record(PlantConfig(seed=1, faults=(FAULT,)), ROWS)
    with task("compiling"):
        for reference in ("auto", "black-box", "arx"):
            config = MonitorConfig(training_min=TRAINING_MIN, reference=reference)
            backtest.run(map(encode, samples_of(record, config.plant)), config)
        prepare([PlantKind(ANY, MonitorConfig(), None)], points=False)
        diagnose(record, cstr())
