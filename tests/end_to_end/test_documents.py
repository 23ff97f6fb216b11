"""README, CONTRIBUTING and docs are true: every command, Python block and settings block works, in order."""

import ast
import contextlib
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.main

from reactorwatch.cli.main import app
from reactorwatch.description.read import find_process
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.runtime.config import SECTIONS, read_settings, section
from tests.unit.runtime.test_config import TABLES

from .conftest import Command
from .given import Files
from .machine import Machine
from .pages import PAGES, ROOT, Block, blocks, inline_commands, words

DECISIONS = sorted((ROOT / "docs" / "decisions").glob("*.md"))
DOCUMENTS = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "tests" / "README.md", *DECISIONS]
JOINS_THE_BUS = (
    *("up", "demo", "plant", "monitor", "record", "replay", "router"),
    *("view", "doctor", "status", "alarm"),
)
"""Commands that run as processes on the page's machine; others are called within this process, which is faster."""

SCREEN = "needs a screen"
ROOT_ONLY = "is for root and a running systemd, tests/integration/test_systemd.py checks the units"
ENGINE = "needs an engine for containers"
CLUSTER = "needs a cluster"
REGISTRY = "needs a registry of images"
INDEX = "needs a package index"
SLOW = "as the commands above, each computes for ten seconds"
DASK = "needs a Dask cluster, tests/integration/{} has one"
DASK_WORKER = "dask worker tls://10.0.0.3:8786 --nthreads 1 --no-nanny --no-dashboard --resources monitor=1"
PLACE = "reactorwatch monitor --config SITE/fleet/monitor/settings.toml --shards 5 --scheduler tls://10.0.0.3:8786"
ON_DASK = [
    "DASK_CONFIG=SITE/fleet/cluster dask scheduler --no-dashboard",
    f"DASK_CONFIG=SITE/fleet/cluster {DASK_WORKER}",
]
OTHERS = "is for several machines, tests/unit/runtime/test_jobs.py has a cluster on loopback"
NOT_HERE = {
    "docs/dashboards.md": [("rerun run.rrd", SCREEN)],
    "docs/deployment.md": [
        *((command, DASK.format("test_cluster_identity.py")) for command in ON_DASK),
        ("docker build --target nodes --build-arg COMMIT=$(git rev-parse HEAD) .", ENGINE),
        ("COMMIT=$(git rev-parse HEAD) docker compose build", ENGINE),
        ("docker buildx imagetools inspect --format '{{.Manifest.Digest}}' python:3.13.9-slim-trixie", REGISTRY),
        ("docker buildx imagetools inspect --format '{{.Manifest.Digest}}' eclipse/zenoh:1.10.2", REGISTRY),
        ("kubectl apply -k deploy/kubernetes", CLUSTER),
        ("kubectl get pods --selector app.kubernetes.io/part-of=reactorwatch", CLUSTER),
        (
            "reactorwatch certify SITE --plant '*' --endpoint tls/router:7447 --listen tls/0.0.0.0:7447",
            CLUSTER,
        ),
        ("kubectl create secret generic router --from-file=SITE/router", CLUSTER),
        ("kubectl create secret generic monitor --from-file=SITE/fleet/monitor", CLUSTER),
        ("kubectl create secret generic recorder --from-file=SITE/fleet/recorder", CLUSTER),
        ("kubectl apply -k deploy/kubernetes/secure", CLUSTER),
        ("cp deploy/systemd/*.service /etc/systemd/system/", ROOT_ONLY),
        (
            "systemd-run --wait --uid=reactorwatch -p CacheDirectory=reactorwatch"
            " -E NUMBA_CACHE_DIR=/var/cache/reactorwatch -E XDG_CACHE_HOME=/var/cache"
            " /opt/reactorwatch/bin/python -m reactorwatch.codegen",
            ROOT_ONLY,
        ),
        ("systemctl enable --now reactorwatch-router reactorwatch@monitor reactorwatch@record", ROOT_ONLY),
        ("cp deploy/systemd/reactorwatch@.service /etc/systemd/system/reactorwatch-shard@.service", ROOT_ONLY),
        ("cp -r deploy/systemd/reactorwatch-shard@.service.d /etc/systemd/system/", ROOT_ONLY),
        ("systemctl enable --now reactorwatch-shard@1 reactorwatch-shard@2", ROOT_ONLY),
        ("pip install 'reactorwatch[metrics]'", INDEX),
    ],
    "docs/diagnosis.md": [
        (f"reactorwatch diagnose {arguments}", SLOW)
        for arguments in (
            "leak.csv --process three_tanks --without leak3",
            "leak.csv --process three_tanks --without leak3 --without pump1 --without leak1",
            "wave.csv --process three_tanks",
        )
    ],
    "docs/fleet.md": [
        (command, DASK.format("test_placement.py"))
        for command in (
            "pip install 'reactorwatch[cluster]'",
            "cp deploy/dask/dask.yaml SITE/fleet/cluster/",
            *ON_DASK,
            f"{PLACE} --state /srv/fleet",
        )
    ],
    "docs/getting-started.md": [(".venv/bin/rerun runs/demo-…/demo.rrd", SCREEN)],
    "docs/many_files.md": [
        ("pip install 'reactorwatch[cluster]'       # here and on each machine", OTHERS),
        ("dask scheduler                            # on one", OTHERS),
        ("dask worker tcp://10.0.0.5:8786 --nworkers 8 --nthreads 1     # on each", OTHERS),
        ("reactorwatch diagnose '/data/runs/*.csv' -o /data/reports --scheduler tcp://10.0.0.5:8786", OTHERS),
    ],
}
"""All commands that this test leaves out, by page, and why; a page's mark gives the same reason."""


SLOW_PAGES = {
    f"docs/{name}.md"
    for name in ("dashboards", "deployment", "diagnosis", "fleet", "getting-started", "many_files", "processes")
}
"""Pages that take more than ten seconds each, but README: it and the other pages are in `make test`."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return Files(tmp_path_factory.mktemp("given"))


@pytest.fixture
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    found = Machine(tmp_path_factory.mktemp("machine"))
    yield found
    found.close()


def run_command(command: str, folder: Path, machine: Machine, called: Command) -> subprocess.CompletedProcess[str]:
    name, *arguments = words(command)
    name = Path(name).name
    if name == "make":  # what it would do: the work itself is in other tests, or takes hours
        planned = ["make", "--dry-run", "--assume-new=pyproject.toml", *arguments]
        return subprocess.run(planned, cwd=ROOT, capture_output=True, text=True, check=False)
    if name == "reactorwatch" and (arguments[0] not in JOINS_THE_BUS or "--verify" in arguments):
        return called(*arguments, cwd=folder)
    return machine.run((name, *arguments), folder)


def run_commands(block: Block, folder: Path, machine: Machine, called: Command) -> None:
    if "not here:" in block.clauses:
        return
    for command in block.commands:
        if "until" in block.clauses:
            machine.start(words(command), folder, block.clauses["until"])
            continue
        done = run_command(command, folder, machine, called)
        assert str(done.returncode) in block.clauses.get("ends with", "0").split(" or "), (
            f"line {block.line}: {command}\n{done.stdout}{done.stderr}"
        )


def check_settings(block: Block, path: Path) -> None:
    path.write_text(block.text, encoding="utf-8")
    tables = read_settings(path)
    assert tables, f"line {block.line}: settings without a table"
    for table in tables:
        section(TABLES[table], table, tables, {})


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if name_of(page) in SLOW_PAGES else [], id=name_of(page))
        for page in PAGES
    ],
)
def test_the_page_works_as_it_is_written(
    page: Path, tmp_path: Path, files: Files, machine: Machine, called: Command
) -> None:
    for block in blocks(page.read_text(encoding="utf-8")):
        for name in filter(None, block.clauses.get("given", "").split(", ")):
            files.give(name, tmp_path)
        if "others end" in block.clauses:
            machine.end_started()
        written = tmp_path / block.clauses.get("file", f"line-{block.line}.{block.kind}")
        match block.kind:
            case "commands":
                run_commands(block, tmp_path, machine, called)
            case "toml" if "[[signals]]" in block.text:
                written.write_text(block.text, encoding="utf-8")
                assert find_process(written).outputs
            case "toml":
                check_settings(block, written)
            case "json":
                parse_extended_model(block.text)
                written.write_text(block.text, encoding="utf-8")
            case "python" if "file" in block.clauses:
                written.write_text(block.text, encoding="utf-8")
                assert find_process(written).outputs
            case "python":
                with contextlib.chdir(tmp_path):
                    exec(compile(block.text, f"{name_of(page)}:{block.line}", "exec"), {"__name__": "example"})
    machine.end_started()


def test_what_is_not_run_here_is_on_the_list_with_its_reason() -> None:
    left_out: dict[str, list[tuple[str, str]]] = {}
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8")):
            if "not here:" in block.clauses:
                found = [(command, block.clauses["not here:"]) for command in block.commands]
                left_out.setdefault(name_of(page), []).extend(found)
    assert left_out == NOT_HERE


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_command_hides_in_another_kind_of_block(page: Path) -> None:
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.kind not in ("commands", "python"):
            assert not re.search(r"^\$? ?(\S*/)?reactorwatch ", block.text, re.MULTILINE), f"line {block.line}"


def test_every_command_within_a_sentence_or_table_has_arguments_that_are_taken() -> None:
    commands = [command for page in DOCUMENTS for command in inline_commands(page.read_text(encoding="utf-8"))]
    assert len(commands) > 20
    for command in commands:
        name, *arguments = words(command)
        known, context = typer.main.get_command(app), None
        while hasattr(known, "resolve_command") and arguments:
            context = known.make_context(name, arguments[:1], parent=context, resilient_parsing=True)
            name, known, arguments = known.resolve_command(context, arguments)
            assert known is not None, command
        if arguments:  # a bare name is that of the command, and no line to type
            known.make_context(name, arguments, parent=context)


def test_from_a_frame_to_a_named_cause_takes_five_lines_and_one_import() -> None:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    first = next(block for block in blocks(page) if block.kind == "python")
    lines = ast.parse(first.text).body
    assert len(lines) <= 5
    imports = [ast.unparse(line) for line in lines if isinstance(line, ast.Import | ast.ImportFrom)]
    assert [line for line in imports if "reactorwatch" in line] == ["import reactorwatch as rw"]
    assert "causes[0]" in ast.unparse(lines[-1])


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = set(re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} <= navigation


def test_every_table_of_settings_is_read_by_its_own_structure() -> None:
    assert tuple(TABLES) == SECTIONS


def test_there_is_an_example_of_each_addition() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    examples = re.findall(r"^## (.*?)$(?:(?!^## ).)*?```python\n", text, re.MULTILINE | re.DOTALL)
    assert examples == [
        *("Add an effect", "Add a chart", "Add a signal check"),
        *("Add a message", "Add a panel", "Add a process model"),
    ]


def test_the_readme_s_make_commands_are_targets_that_set_up_by_themselves() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    made = [words(line)[1] for block in blocks(text) for line in block.commands if line.startswith("make ")]
    assert made == ["demo", "test"]
    for target in made:
        planned = subprocess.run(
            ["make", "--dry-run", "--assume-new=pyproject.toml", target],
            cwd=ROOT, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        assert "venv" in planned
        assert {"demo": "reactorwatch demo", "test": "pytest"}[target] in planned


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_every_link_within_the_repository_leads_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text(encoding="utf-8")):
        assert (document.parent / target).exists(), target
