"""The documentation site builds strictly: every link, anchor and name of the API reference leads somewhere."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from .pages import ROOT

pytest.importorskip("mkdocs", reason="needs the extra docs")
pytest.importorskip("material", reason="needs the extra docs")

OWN_DOMAINS = r'(?:src|srcset)="https?:|<link[^>]+rel="stylesheet"[^>]+href="https?:|@import "https?:'


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site; a warning ends the build with an error."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_no_page_fetches_anything_from_the_network(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    assert [page.name for page in pages if re.search(OWN_DOMAINS, page.read_text(encoding="utf-8"))] == []


def test_the_references_hold_every_command_message_and_public_name(site: Path) -> None:
    commands = (site / "reference/commands.html").read_text(encoding="utf-8")
    assert all(
        f'id="{name}"' in commands for name in ("up", "diagnose", "example", "alarm-acknowledge", "charts-arl-shewhart")
    )
    assert "--incident" in commands
    messages = (site / "reference/messages.html").read_text(encoding="utf-8")
    assert all(f'id="{name.lower()}"' in messages for name in ("Sample", "Alarm", "Health", "Baseline"))
    names = (site / "reference/python.html").read_text(encoding="utf-8")
    assert all(f"rw.{name}" in names for name in ("read_record", "diagnose", "Monitor", "Record"))


def test_the_search_index_holds_the_pages(site: Path) -> None:
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    assert {"getting-started.html", "alarms.html"} <= {item["location"] for item in index["docs"]}
