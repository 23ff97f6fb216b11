"""No file of the product imports itself through others."""

from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

PACKAGES = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node")


def order(graph: grimp.ImportGraph) -> list[str]:
    """Modules, each after those that it imports, wherever in it: in functions and for types, too."""
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    return list(TopologicalSorter(imports).static_order())


def test_no_file_imports_itself_through_others() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    assert set(order(graph)) == graph.modules


def test_an_import_in_a_function_or_for_types_closes_a_circle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "circular_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "first.py").write_text("def one():\n    from circular_package.second import two\n")
    (package / "second.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from circular_package.first import one\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(CycleError):
        order(grimp.build_graph("circular_package", cache_dir=None))
