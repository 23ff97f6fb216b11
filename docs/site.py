"""Hooks of the documentation site: generated pages, links out of this folder, diagrams without the network.

The pages of this folder are read in the repository as they are. For the site, a link to a file of the repository that
is no page becomes its path, and a Mermaid state diagram a table of its transitions (Mermaid would be fetched from the
network). Command, message and Python reference are generated from the program.
"""

import inspect
import json
import re
import sys
from pathlib import Path
from typing import Any

import typer.main
from markdown import Extension, Markdown
from markdown.preprocessors import Preprocessor
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

EXAMPLES = ROOT / "examples"
EXECUTED = ROOT / "build" / "examples"
"""Notebooks with their output, as `make examples` leaves them."""

PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md"}
"""Pages outside of this folder, with their names on the site."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")
_MERMAID = re.compile(r"```mermaid\nstateDiagram-v2\n(.*?)```", re.DOTALL)
_INLINE_CODE = re.compile(r"(?<!</span>)<code>[^<\n]+</code>")
_BOX = re.compile(r"^┏[^\n]*\n(.*?)^└[^\n]*\n", re.DOTALL | re.MULTILINE)
_MARK = re.compile(r"^<!-- run: .* -->\n", re.MULTILINE)


class DoctestFences(Preprocessor):
    """Fence the examples in docstrings, which begin with `>>>`."""

    def run(self, lines: list[str]) -> list[str]:
        """See `Preprocessor`."""
        fenced: list[str] = []
        within = False
        for line in lines:
            starts = line.lstrip().startswith(">>> ")
            if starts and not within:
                fenced.append("```pycon")
            elif within and not line.strip():
                fenced.append("```")
            within = starts or (within and bool(line.strip()))
            fenced.append(line.strip() if within else line)
        return [*fenced, "```"] if within else fenced


class DoctestExtension(Extension):
    """Markdown extension of `DoctestFences`."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 # the interface of Markdown
        """See `Extension`."""
        md.preprocessors.register(DoctestFences(md), "doctest", 200)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the parts of the navigation that follow from folders."""
    config.markdown_extensions.append(DoctestExtension())
    decisions = {_title(path): f"decisions/{path.name}" for path in sorted((ROOT / "docs/decisions").glob("*.md"))}
    examples = {_notebook_title(path): f"examples/{path.stem}.md" for path in _notebooks()}
    for part in config.nav or []:
        for name, pages in (("Decisions", decisions), ("Examples", examples)):
            if name in part:
                part[name] = [{title: page} for title, page in pages.items()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add generated pages, and those of the repository's root."""
    for source, name in PAGES.items():
        _add(files, config, name, (ROOT / source).read_text(encoding="utf-8"), source)
    for name, text in (
        ("reference/commands.md", command_reference()),
        ("reference/messages.md", message_reference()),
        ("reference/python.md", python_reference()),
    ):
        _add(files, config, name, text)
    for path in _notebooks():
        text, pictures = notebook_page(path)
        _add(files, config, f"examples/{path.stem}.md", text)
        for name, content in pictures.items():
            files.append(File.generated(config, f"examples/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite links that leave this folder, and diagrams; drop marks for the tests."""
    source = getattr(page.file, "repository_path", None) or f"docs/{page.file.src_uri}"

    def rewrite(match: re.Match[str]) -> str:
        picture, text, target, anchor = match.groups()
        path = (ROOT / source).parent.joinpath(target).resolve()
        if not path.is_relative_to(ROOT):
            return match[0]
        inside = str(path.relative_to(ROOT))
        name = PAGES.get(inside) or inside.removeprefix("docs/")
        if (inside.startswith("docs/") and path.is_file()) or inside in PAGES:
            up = "../" * page.file.src_uri.count("/")
            return f"{picture}[{text}]({up}{name}{anchor or ''})"
        if path.exists():
            code = text if "`" in text else f"`{inside}`"
            return code if text in (target, f"`{inside}`", code) or "/" in text else f"{text} ({code})"
        return match[0]

    if page.file.src_uri.startswith("examples/"):
        return markdown
    tables = _BOX.sub(lambda match: f"```\n\n{_table(match[1])}\n\n```\n", _LINK.sub(rewrite, markdown))
    return _MARK.sub("", _MERMAID.sub(lambda match: _transitions(match[1]), tables))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Keep the names of options whole, and let long names break after `_`, `/` and `.`."""

    def mark(match: re.Match[str]) -> str:
        whole = re.sub(r"(?<![\w-])--?[a-z][\w-]*", r'<span class="option">\g<0></span>', match[0])
        return re.sub(r"(?<=\w)[_/.](?=[\w*])", r"\g<0><wbr>", whole)

    return _INLINE_CODE.sub(mark, html)


# --- generated pages ---------------------------------------------------------------------------------------------


def command_reference() -> str:
    """Reference of the command line: each command with its help, arguments and options."""
    from reactorwatch.cli.main import app
    from reactorwatch.cli.option_groups import GROUPS

    root = typer.main.get_command(app)
    parts = ["# Commands", "", "Generated from the program. `reactorwatch COMMAND --help` prints the same."]
    folded: dict[str, dict[str, str]] = {group: {} for group in GROUPS}
    _describe_commands(root, "reactorwatch", parts, folded)
    for group, options in folded.items():
        parts += ["", f"## {GROUPS[group]}", "", f"Options of the commands that have `--help-{group}`.", ""]
        parts += ["| option | meaning |", "|---|---|", *options.values()]
    return "\n".join(parts) + "\n"


def _describe_commands(command: Any, name: str, parts: list[str], folded: dict[str, dict[str, str]]) -> None:
    if hasattr(command, "commands"):
        for word, inner in command.commands.items():
            if not inner.hidden:
                _describe_commands(inner, f"{name} {word}", parts, folded)
        return
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(command.collect_usage_pieces(context))
    parts += ["", f"## {name.removeprefix('reactorwatch ')}", "", inspect.cleandoc(command.help or ""), ""]
    parts += ["```text", f"{name} {usage}".strip(), "```", "", "| option | meaning |", "|---|---|"]
    for item in command.params:
        group = folded.get(getattr(item, "rich_help_panel", None) or "")
        if group is None and getattr(item, "hidden", False):
            continue
        words = item.opts if item.param_type_name == "option" else [str(item.name).upper()]
        names = ", ".join(f"`{word}`" for word in words)
        default = _default(item)
        text = " ".join((getattr(item, "help", None) or "").split()).replace("|", "\\|").replace("<", "&lt;")
        row = f"| {names} | {text}{default} |"
        if group is None:
            parts.append(row)
        else:
            group.setdefault(names, row)


def _default(item: Any) -> str:
    if not getattr(item, "show_default", False) or item.default in (None, False, (), []) or callable(item.default):
        return ""
    return f" [{item.default}]"


def message_reference() -> str:
    """Reference of the messages on the bus, from their declaration with its comments."""
    text = (ROOT / "reactorwatch/contract/messages.proto").read_text(encoding="utf-8")
    parts = [
        "# Messages",
        "",
        "Generated from `reactorwatch/contract/messages.proto`; keys and commands: [On the bus](../bus.md).",
    ]
    pattern = re.compile(r"((?:^//[^\n]*\n)*)^(message|enum) (\w+) \{([^}]*)\}(?: *//([^\n]*))?", re.MULTILINE)
    for comment, kind, name, body in (match.groups()[:4] for match in pattern.finditer(text)):
        about = " ".join(line.removeprefix("//").strip() for line in comment.splitlines())
        command = re.search(r"//\s*(command/[^\n]*)", body.split("\n")[0])
        parts += ["", f"## {name}", "", _escape(about or (command[1] if command else ""))]
        rows = re.findall(r"^\s+(?:(repeated )?([\w.<>, ]+?) )?(\w+) = (\d+);(?:\s*//\s*([^\n]*))?", body, re.MULTILINE)
        head = "| number | field | type | meaning |" if kind == "message" else "| number | value | | meaning |"
        parts += ["", head, "|---|---|---|---|"] if rows else []
        for repeated, of_type, field, number, meaning in rows:
            shown = f"{repeated}{of_type}".strip()
            parts.append(f"| {number} | `{field}` | {f'`{shown}`' if shown else ''} | {_escape(meaning)} |")
    return "\n".join(parts) + "\n"


def python_reference() -> str:
    """Reference of the public Python names, from their docstrings."""
    import reactorwatch

    parts = ["# Python", "", "Generated from the docstrings. An introduction is [From Python](../python.md)."]
    for name in reactorwatch.__all__:
        found = getattr(reactorwatch, name)
        if inspect.ismodule(found):
            path = found.__name__
        elif inspect.isclass(found) or inspect.isfunction(found):
            path = f"{found.__module__}.{found.__qualname__}"
        else:
            continue
        parts += ["", f"::: {path}", "    options:", f"      heading: rw.{name}", "      members_order: source"]
    return "\n".join(parts) + "\n"


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """Page of a notebook, with the outputs of its last execution if there was one; and its pictures by name."""
    import base64

    executed = EXECUTED / path.name
    cells = json.loads((executed if executed.is_file() else path).read_text(encoding="utf-8"))["cells"]
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        printed = _without_spinner("".join("".join(item.get("text", "")) for item in cell.get("outputs", [])))
        if printed:
            parts.append(f"```text\n{printed}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Figure of the cell above]({name})")
            elif "text/html" in data:
                parts.append("".join(data["text/html"]))
            elif "text/plain" in data:
                parts.append(f"```text\n{''.join(data['text/plain']).rstrip()}\n```")
    parts.append(f"*The notebook: `examples/{path.name}`; `make examples` executes all of them.*")
    return "\n\n".join(parts) + "\n", pictures


# --- within ------------------------------------------------------------------------------------------------------


def _add(files: Files, config: MkDocsConfig, name: str, text: str, repository_path: str | None = None) -> None:
    file = File.generated(config, name, content=text)
    file.repository_path = repository_path  # type: ignore[attr-defined]
    files.append(file)


def _without_spinner(text: str) -> str:
    """Output of a command as it stands on the terminal at the end: without the spinner that it erased."""
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", plain)]
    return "\n".join(line for line in lines if line and not re.match(r"[\u2800-\u28ff]", line))


def _notebooks() -> list[Path]:
    return sorted(EXAMPLES.glob("*.ipynb"))


def _notebook_title(path: Path) -> str:
    first = "".join(json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"])
    return first.splitlines()[0].lstrip("# ")


def _title(path: Path) -> str:
    first = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
    return f"{path.name[:4]} {first.split(': ', 1)[-1]}"


def _transitions(diagram: str) -> str:
    """A Mermaid state diagram as a table of its transitions."""
    names = dict(re.findall(r'state "([^"]+)" as (\w+)', diagram))
    by_symbol = {symbol: name for name, symbol in names.items()}
    rows = [
        f"| {by_symbol.get(start, start)} | {events.strip()} | {by_symbol.get(end, end)} |"
        for start, end, events in re.findall(r"^\s+(\w+) --> (\w+):([^\n]*)", diagram, re.MULTILINE)
    ]
    return "\n".join(["| from | event | to |", "|---|---|---|", *rows])


def _table(boxed: str) -> str:
    """A table drawn with lines, as of a terminal, in Markdown."""
    rows = [re.split("[┃│]", line)[1:-1] for line in boxed.splitlines() if line[0] in "┃│"]
    rows.insert(1, ["---"] * len(rows[0]))
    return "\n".join(f"|{'|'.join(cells)}|" for cells in rows)


def _escape(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
