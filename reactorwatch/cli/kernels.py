"""Compilation of all numerical kernels ahead of their first call: `python -m reactorwatch.codegen`, or a first start.

Kernels are compiled at their first call and cached on disk (`reactorwatch.codegen.numba_kernel`,
`codegen.compiled_function`). On a new machine that call interrupts a monitor or a diagnosis, for half a minute in all.
So all kernels run here once, over a short simulated record: by `make setup`, by the images, or before the first node of
this version on a machine is ready.
"""

import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numba
import platformdirs
import structlog

from monitor_node.config import MonitorConfig
from monitor_node.fleet import ANY, PlantKind, prepare
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.process.library.cstr import cstr
from reactorwatch.version import version
from recorder.tools.player import samples_of

log = structlog.get_logger()
ROWS = 600
"""Rows of the record: enough for a diagnosis, and for a fault after the monitor's training."""

FAULT = "coolant_flow:step:-0.1@30min"
TRAINING_MIN = 15.0
"""Half of the time before the fault."""
REFERENCES: tuple[Literal["auto", "black-box", "arx"], ...] = ("auto", "black-box", "arx")


def compile_kernels() -> None:
    """Compile the numerical kernels, and note that this machine has them."""
    record = simulate_record(PlantConfig(seed=1, faults=(FAULT,)), ROWS)
    parts = len(REFERENCES) + 2
    for part, reference in enumerate(REFERENCES, start=1):
        log.info("compiling the numerical kernels", part=f"{part}/{parts}", of=f"monitor, reference {reference}")
        config = MonitorConfig(training_min=TRAINING_MIN, reference=reference)
        backtest.run(map(encode, samples_of(record, config.plant)), config)
    log.info("compiling the numerical kernels", part=f"{parts - 1}/{parts}", of="causes after an alarm")
    prepare([PlantKind(ANY, MonitorConfig(), None)], points=False)
    log.info("compiling the numerical kernels", part=f"{parts}/{parts}", of="diagnosis")
    diagnose(record, cstr())
    with suppress(OSError):
        _mark().parent.mkdir(parents=True, exist_ok=True)
        _mark().touch()


def is_first_start() -> bool:
    """True if this installation never compiled its kernels for this user."""
    return not _mark().exists()


def compile_at_first_start() -> None:
    """Compile the kernels at the first start; not where no mark of it can be left."""
    if not is_first_start():
        return
    try:
        _mark().parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(_mark().parent, os.W_OK)
    except OSError:
        writable = False
    if writable:
        log.info("first start of this version: compiling once, half a minute")
        compile_kernels()
    else:
        log.warning("kernels are compiled when they are first called", why=f"{_mark().parent} cannot be written to")


def _mark() -> Path:
    """File that shows that the kernels of this version are compiled where this installation looks for them."""
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    place = f"{Path(__file__).resolve()} {os.environ.get('NUMBA_CACHE_DIR', '')}"
    digest = hashlib.blake2b(place.encode(), digest_size=6).hexdigest()
    name = f"kernels-{version()}-python{python}-numba{numba.__version__}-{digest}"
    return platformdirs.user_cache_path("reactorwatch") / name
