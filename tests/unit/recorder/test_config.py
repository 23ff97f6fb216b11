"""The settings of the recorder and of the replay, and what a file is called."""

import math
import sys
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section
from reactorwatch.runtime.node_main import main
from recorder.__main__ import run
from recorder.config import RecorderConfig, ReplayConfig
from recorder.recording_files import file_names

NOON_IN_BERLIN = datetime(2026, 7, 1, 12, 0, 5, tzinfo=timezone(timedelta(hours=2)))


def test_the_defaults_record_everything() -> None:
    config = section(RecorderConfig, "recorder", {}, {})
    assert (config.plant, config.key_expression, config.health_period_s) == ("cstr", "reactor/**", 5.0)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"plant": "a/b"}, "plant name must be"),
        ({"health_period_s": 0.0}, "health_period_s must be positive and finite, got 0.0"),
        ({"flush_period_s": math.inf}, "flush_period_s must be positive and finite, got inf"),
        ({"flush_period_s": 1.5}, "flush_period_s must be at most 1, got 1.5"),
        ({"fsync": "often"}, "fsync: unknown word 'often' .valid: never, chunk, second"),
        ({"rotate_min": 0.0}, "rotate_min must be positive, or inf, got 0.0"),
        ({"keep_mb": math.nan}, "keep_mb must be positive, or inf, got nan"),
        ({"keep_files": 0.0}, "keep_files must be at least 1, or inf, got 0.0"),
        ({"black_box_min": -1.0}, "black_box_min must be finite and not negative, got -1.0"),
        ({"most_keys": 10}, r"most_keys must be in \[100, 60000\], got 10"),
        ({"most_keys": 60_001}, r"most_keys must be in \[100, 60000\], got 60001"),
        ({"period": 1}, "unknown key 'period'"),
    ],
)
def test_an_impossible_setting_is_reported_in_one_line(values: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        section(RecorderConfig, "recorder", {"recorder": values}, {})


def test_a_replay_may_be_as_fast_as_it_goes_but_not_stand_still() -> None:
    assert section(ReplayConfig, "replay", {}, {"file": "x.csv", "rate": math.inf}).rate == math.inf
    with pytest.raises(InputError, match=r"rate must be positive, got 0\.0"):
        section(ReplayConfig, "replay", {}, {"file": "x.csv", "rate": 0.0})
    with pytest.raises(InputError, match="from_min must be before to_min, got 5 and 5"):
        section(ReplayConfig, "replay", {}, {"file": "x.csv", "from_min": 5.0, "to_min": 5.0})
    with pytest.raises(InputError, match="file"):
        section(ReplayConfig, "replay", {}, {})


def test_a_file_is_named_after_the_plant_and_the_time_in_utc(tmp_path: Path) -> None:
    config = RecorderConfig(plant="cstr", out=str(tmp_path))
    assert file_names(config).first(NOON_IN_BERLIN) == tmp_path / "cstr-20260701T100005Z.mcap"


def test_out_may_name_the_file(tmp_path: Path) -> None:
    config = RecorderConfig(out=str(tmp_path / "run.mcap"))
    assert file_names(config).first(NOON_IN_BERLIN) == tmp_path / "run.mcap"


def test_the_process_ends_with_2_and_one_line_before_it_looks_for_a_router(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(f'[recorder]\nout = "{tmp_path}/none/run.mcap"\n')
    monkeypatch.setattr(sys, "argv", ["recorder", str(settings)])
    assert main("recorder", "recorder", RecorderConfig, run) == 2
    assert (
        capsys.readouterr().err
        == f"recorder: recording {tmp_path}/none/run.mcap: the folder {tmp_path}/none does not exist\n"
    )
    monkeypatch.setattr(sys, "argv", ["recorder", "a", "b"])
    assert main("recorder", "recorder", RecorderConfig, run) == 2
    assert "usage: python -m recorder [settings.toml]" in capsys.readouterr().err
