# SPDX-License-Identifier: Apache-2.0
"""Old names of settings work everywhere, with one warning that gives the new name."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

from garps_core import Config
from garps_core.config import renamed
from garps_core.config.renamed import RENAMED, Renamed
from garps_core.config.text import changed_config, read_settings

EXPECTED = Config().replace({"alignment.effective_measurements": 7.0})


@pytest.fixture(autouse=True)
def nothing_said_yet() -> Iterator[None]:
    renamed.warn_once.cache_clear()
    yield
    renamed.warn_once.cache_clear()


def test_the_new_names_exist_and_the_old_do_not() -> None:
    settings = Config().settings()
    assert all(row.new in settings and row.old not in settings for row in RENAMED)
    assert len({row.old for row in RENAMED}) == len(RENAMED)


def test_an_old_name_works_in_python_in_files_and_in_text(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("alignment:\n  information: 7.0\n", encoding="utf-8")
    assert Config().replace({"alignment.information": 7.0}) == EXPECTED
    assert read_settings(file) == EXPECTED
    assert changed_config(Config(), ["alignment.information=7"]) == EXPECTED


def test_the_warning_comes_once_and_names_the_new_one(caplog: pytest.LogCaptureFixture) -> None:
    for value in (7.0, 8.0):
        Config().replace({"alignment.information": value, "alignment.brightness": 0.1})
    first, second = caplog.messages
    assert first.startswith("alignment.information is now called alignment.effective_measurements: ")
    assert second.startswith("alignment.brightness is now called alignment.brightness_measurements: ")
    assert {record.name for record in caplog.records} == {"garps_core"}


def test_words_of_a_setting_may_be_renamed_with_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    row = Renamed("lifting.weights", "lifting.weighting", {"same": "equal"})
    monkeypatch.setattr(renamed, "RENAMED", (row,))
    assert Config().replace({"lifting.weights": "same"}).lifting.weighting == "equal"
    assert changed_config(Config(), ["lifting.weights=area"]).lifting.weighting == "area"
    first, second = caplog.messages
    assert first.startswith("lifting.weights=same is now called lifting.weighting=equal: ")
    assert second.startswith("lifting.weights is now called lifting.weighting: ")


def test_the_command_says_it_on_stderr() -> None:
    words = ["align", "a.png", "b.png", "--K", "500", "500", "320", "240", "--set", "alignment.information=7"]
    done = subprocess.run([sys.executable, "-m", "garps_core.cli", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2  # there is no a.png
    assert done.stderr.count("alignment.information is now called alignment.effective_measurements") == 1
