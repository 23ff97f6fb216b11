"""Words that definitions of the product may not use, and the command that shortens the list of those that still do.

    python -m tests.words          drop the entries of the baseline that no longer apply
    python -m tests.words --add    also add what is new, after a merge that moved definitions

`tests/unit/test_words.py` holds the product to it.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node", "benchmarks")
GENERATED = {"messages_pb2.py"}
BASELINE = ROOT / "tests" / "unit" / "words_baseline.txt"


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


IRREGULAR = _words("""
    become been begun borne bought broken brought built caught chosen come done drawn driven eaten fallen felt found
    forgotten frozen given gone grown heard held hidden kept known laid learnt led left lent lost made meant met paid
    risen said seen sent shown slept sold sought spent spoken stolen stood stuck sunk swept taken taught thought thrown
    told torn understood undone won worn written
""")
"""Past participles without -ed that are no imperative as well (`set`, `put`, `read`, `cut` and `run` are)."""
NOT_PARTICIPLES = _words("bed bleed breed embed exceed feed hundred indeed need proceed red seed shed speed succeed")
PREDICATES = _words("are can had has have is must on should was were")
"""First words that make a predicate (is_closed) or an event (on_closed) of a participle."""
IMPERATIVES = _words("""
    add check count drop list map mark note pop presume publish run search skip solve subscribe
""")
"""First words of which a participle is the object or the manner: count_lost, map_unordered."""
CONJUNCTIONS = _words("be if until when while")
PARTICLES = _words("""
    after again anew apart as at away back before between by down for from here in into now of off on once out over
    since so then there to together twice until up with yet
""")
"""Words after a participle that are no nouns."""

HEAD = re.compile(
    r"\W*(What|Whether|How|Which|Where|Who|Whose|Whom|When|Why|Until|Of|Likewise|Is|Are|Does|Did|Can|Has|Have)\b"
)
FRAGMENT = re.compile(
    r"^\s+\*{0,2}\w+(?: \(.*?\))?: (?:(?:of|whose|as for|as in|likewise|as it is|as above)\b|(?:its|their) \w+[.;,])",
    re.MULTILINE,
)
PEOPLE = re.compile(
    r"\b(he|him|his|she|who|whom|whoever|nobody|ours|strangers?|vouch(?:es|ed)?|told|anew|likewise)\b", re.IGNORECASE
)
PERSONAL_NAME = re.compile(
    r"(?:^|_)(?:anew|anybody|everybody|felt|goes_on|he|hears?|heard|him|his|likewise|nobody|ours|said|says?|somebody"
    r"|strangers?|tells?|told|who|whoever|whom)(?=_|$)",
    re.IGNORECASE,
)
"""Names in the tests state their claim in the field's words: a node publishes and receives, an error is reported."""

EXCEPTIONS = {
    "reactorwatch/api/diagnosis.py::DiagnosisResult.extended: participle": "a public name",
}
"""Entries that stay, each with its reason."""

_Function = ast.FunctionDef | ast.AsyncFunctionDef
_Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
_Assignment = ast.Assign | ast.AnnAssign


def is_participle(name: str) -> bool:
    """A name is a past participle, or ends in one that no noun follows."""
    first, *rest = name.strip("_").lower().split("_")
    if rest and first in PREDICATES | IMPERATIVES:
        return False
    parts = [first, *rest]
    while len(parts) > 1 and parts[-1] in PARTICLES:
        parts.pop()
    if len(parts) > 1 and parts[-2] in CONJUNCTIONS:
        return False
    last = parts[-1]
    return last in IRREGULAR or (len(last) > 3 and last.endswith("ed") and last not in NOT_PARTICIPLES)


def violations(source: str) -> set[str]:
    """`name: rule` of each definition of a module that breaks a rule."""
    tree = ast.parse(source)
    owners: dict[int, str] = {}
    found: set[str] = set()
    definitions = list(_definitions(tree))
    for name, node in definitions:
        owners.update(dict.fromkeys(range(_first_line(node), (node.end_lineno or node.lineno) + 1), name))
        if isinstance(node, _Function) and is_participle(node.name) and not _is_flag(node):
            found.add(f"{name}: participle")
    docstrings: set[int] = set()
    for name, constant, text in _docstrings(tree, definitions):
        docstrings.add(id(constant))
        if HEAD.match(text):
            found.add(f"{name}: head")
        if FRAGMENT.search(text):
            found.add(f"{name}: fragment")
        found |= _people(name, text)
    for part in ast.walk(tree):
        if not (isinstance(part, ast.Constant) and isinstance(part.value, str)) or id(part) in docstrings:
            continue
        if " " in part.value:  # a text for people; one word is a key or a name
            found |= _people(owners.get(part.lineno, "module"), part.value)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            found |= _people(owners.get(token.start[0], "module"), token.string)
    return found


def entries() -> set[str]:
    """`path::name: rule` of each definition of the product that breaks a rule."""
    files = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py") if file.name not in GENERATED)
    return {
        f"{file.relative_to(ROOT).as_posix()}::{violation}"
        for file in files
        for violation in violations(file.read_text(encoding="utf-8"))
    }


def entries_of_tests() -> list[str]:
    """`path::name: rule` of the names and first lines in the tests that break a rule."""
    return [
        f"{file.relative_to(ROOT).as_posix()}::{violation}"
        for file in sorted((ROOT / "tests").rglob("*.py"))
        for violation in violations_of_test(file.read_text(encoding="utf-8"))
    ]


def violations_of_test(source: str) -> list[str]:
    """`name: rule` of the names and the first line of a module of the tests."""
    tree = ast.parse(source)
    first_line = (ast.get_docstring(tree) or "").partition("\n")[0]
    broken = ["module: head"] if HEAD.match(first_line) or PEOPLE.search(first_line) else []
    names = (name for name, node in _definitions(tree) if isinstance(node, _Definition))
    return broken + [f"{name}: people" for name in names if PERSONAL_NAME.search(name.rpartition(".")[2])]


def baseline() -> set[str]:
    """Entries of the definitions that are not renamed yet."""
    return set(BASELINE.read_text(encoding="utf-8").splitlines())


def _people(name: str, text: str) -> set[str]:
    return {f"{name}: people, {word.lower()}" for word in PEOPLE.findall(text)}


def _first_line(node: _Definition | _Assignment) -> int:
    decorators = [] if isinstance(node, _Assignment) else node.decorator_list
    return min([node.lineno, *(item.lineno for item in decorators)])


def _is_flag(node: _Function) -> bool:
    """A property that is true or false is an adjective, like closed of a file."""
    decorated = {ast.unparse(item).rpartition(".")[2] for item in node.decorator_list}
    return node.returns is not None and ast.unparse(node.returns) == "bool" and "property" in decorated


def _definitions(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, _Definition | _Assignment]]:
    """Classes and functions with their qualified names, and the assignments of modules and classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, _Definition):
            yield prefix + child.name, child
            yield from _definitions(child, f"{prefix}{child.name}.")
        elif isinstance(child, _Assignment) and isinstance(node, ast.Module | ast.ClassDef):
            yield prefix + _target(child), child
        else:
            yield from _definitions(child, prefix)


def _target(node: _Assignment) -> str:
    return ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)


def _docstrings(
    tree: ast.Module, definitions: list[tuple[str, _Definition | _Assignment]]
) -> Iterator[tuple[str, ast.Constant, str]]:
    """Docstrings of a module, of its classes and functions, and below assigned names."""
    modules: list[tuple[str, ast.Module | _Definition | _Assignment]] = [("module", tree)]
    for name, node in [*modules, *definitions]:
        if isinstance(node, _Assignment):
            continue
        before: ast.stmt | None = None
        for statement in node.body:
            match statement:
                case ast.Expr(ast.Constant(str(text)) as constant) if before is None:
                    yield name, constant, text
                case ast.Expr(ast.Constant(str(text)) as constant) if isinstance(before, _Assignment):
                    yield f"{'' if name == 'module' else name + '.'}{_target(before)}", constant, text
            before = statement


def main() -> None:
    """Rewrite the baseline."""
    parser = argparse.ArgumentParser(description="Drop the entries of the baseline that no longer apply.")
    parser.add_argument("--add", action="store_true", help="also add entries that are new")
    now = entries() - EXCEPTIONS.keys()
    kept = now if parser.parse_args().add else now & baseline()
    BASELINE.write_text("".join(f"{entry}\n" for entry in sorted(kept)), encoding="utf-8")
    sys.stdout.write(f"{len(kept)} entries; {len(now - kept)} breaches are not among them\n")


if __name__ == "__main__":
    main()
