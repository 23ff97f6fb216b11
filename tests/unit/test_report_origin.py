"""A report states when, by what, from what and how it was made."""

import hashlib
from pathlib import Path

from reactorwatch.api.shown import report_origin
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.version import this_build
from tests.unit.diagnosis.cases import CASES


def test_it_has_time_version_file_hash_and_the_settings_that_were_chosen(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_bytes(b"time_min,qc\n")
    origin = report_origin(file, {"process": "cstr", "plant": None, "tolerance": {"T": 0.5}})
    assert origin["software"] == f"reactorwatch {this_build()}"
    assert origin["SHA-256 of the file"] == hashlib.sha256(b"time_min,qc\n").hexdigest()
    assert origin["settings"] == "process cstr, tolerance T=0.5"
    assert origin["made"][:2] == "20"
    assert origin["made"][-5] in "+-"
    assert "SHA-256 of the file" not in report_origin(tmp_path, {})


def test_the_page_shows_it_as_text_and_omits_it_where_there_is_none() -> None:
    arguments = (CASES["named"], cstr(), EFFECTS, "a.csv", "extended.json")
    page = as_page(*arguments, origin={"file": "<a>.csv"})
    assert '<tr><th>file</th><td class="any">&lt;a&gt;.csv</td></tr>' in page
    assert "This report" not in as_page(*arguments)
