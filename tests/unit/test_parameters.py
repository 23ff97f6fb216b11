"""A function of the nodes and the runtime has at most 8 parameters; what travels together is one object."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("monitor_node", "recorder", "plant_node", "diagnosis_node", "reactorwatch/runtime")
MOST = 8


def is_compiled(function: ast.FunctionDef) -> bool:
    """True for a function whose machine code takes arrays and numbers, no objects."""
    return any(isinstance(item, ast.Name) and item.id in ("jit", "inline") for item in function.decorator_list)


def parameters(function: ast.FunctionDef) -> list[str]:
    """Names of a function's parameters, without the object of a method."""
    arguments = function.args
    names = [item.arg for item in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls")]


def test_no_function_has_more_parameters_than_a_reader_can_hold() -> None:
    long = {
        f"{path.relative_to(ROOT)}::{node.name}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and not is_compiled(node) and len(parameters(node)) > MOST
    }
    assert long == set()
