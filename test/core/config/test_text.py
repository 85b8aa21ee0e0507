# SPDX-License-Identifier: Apache-2.0
"""Settings in a YAML file: the same for the command, the replay, the benches and the node; mistakes are one line."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import run
from garps_core import Config, ConfigError
from garps_core.cli import command
from garps_core.config.text import MAX_BYTES, preset_in, read_settings, write_settings
from garps_ros import replay


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    changes = {
        "alignment.effective_measurements": 6.1,
        "lifting.noise_floor_m": 1e-05,
        "start.features": False,
        "lifting.stride": 4,
        "lifting.weighting": "equal",
    }
    write_settings(tmp_path / "a.yaml", "monocular", changes, "chosen by hand\nfor a test")
    assert read_settings(tmp_path / "a.yaml") == Config.preset("monocular").replace(changes)
    assert (tmp_path / "a.yaml").read_text().startswith("# chosen by hand\n# for a test\npreset: monocular\n")


@given(value=st.floats(1e-3, 1e6), tiny=st.floats(0, 1))
def test_numbers_keep_every_digit(tmp_path_factory: pytest.TempPathFactory, value: float, tiny: float) -> None:
    path = tmp_path_factory.getbasetemp() / "numbers.yaml"
    write_settings(path, "default", {"alignment.effective_measurements": value, "lifting.noise_floor_m": tiny})
    found = read_settings(path)
    assert (found.alignment.effective_measurements, found.lifting.noise_floor_m) == (value, tiny)


def test_plain_and_nested_files(tmp_path: Path) -> None:
    base = Config.preset("monocular")
    plain = read_settings(written(tmp_path, "lifting.stride: 4\nalignment.effective_measurements: 7\n"), base)
    nested = read_settings(written(tmp_path, "lifting: {stride: 4}\nalignment:\n  effective_measurements: 7\n"), base)
    assert plain == nested == base.replace({"lifting.stride": 4, "alignment.effective_measurements": 7})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "holds list: expected lines like"),
        ("", "holds NoneType: expected lines like"),
        ("lifting.strid: 4", "did you mean 'lifting.stride'"),
        ("lifting.stride: 4.5", "expected an integer"),
        ("lifting.stride: 99", "expected between 1 and 32"),
        ("preset: best", "preset 'best' does not exist"),
        ("{", "cannot read settings"),
        ("a: !!python/object/apply:os.system ['true']", "could not determine a constructor"),
        ("a: &a [*a]", "setting 'a' does not exist"),
        ("[" * 2000, "cannot read settings"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read_settings(written(tmp_path, text))
    assert message in str(caught.value) and str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "large.yaml").write_bytes(b"#" * (MAX_BYTES + 1))
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for name, message in (("large", "at most"), ("binary", "cannot read"), ("missing", "No such file")):
        with pytest.raises(ConfigError, match=message):
            read_settings(tmp_path / f"{name}.yaml")


def test_the_command_takes_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, "lifting.strid: 4")
    words = ["align", "a.png", "b.png", "--K", "500", "500", "320", "240", "--settings", str(path)]
    assert command.main(words) == 2
    assert "did you mean 'lifting.stride'" in capsys.readouterr().err


def test_a_preset_that_is_asked_for_stands_above_the_files(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = written(tmp_path, "preset: paper\nlifting.stride: 4\n")
    assert read_settings(path, Config.preset("monocular")) == Config.preset("paper").replace({"lifting.stride": 4})
    assert preset_in(path) == "paper" and not caplog.records
    asked = Config.preset("monocular").replace({"seed": 3})
    assert read_settings(path, asked, "monocular") == asked.replace({"lifting.stride": 4})
    (note,) = caplog.messages
    assert note == f"the preset is monocular, as asked for, and not paper, which {path} names"


@pytest.mark.parametrize(("asked", "named"), [("sensor", "default"), ("monocular", "monocular")])
def test_two_names_of_one_preset_agree(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, asked: str, named: str
) -> None:
    assert read_settings(written(tmp_path, f"preset: {named}"), Config.preset(asked), asked) == Config.preset(asked)
    assert not caplog.records


def test_a_preset_that_does_not_exist_is_an_error_also_where_it_does_not_count(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"settings\.yaml: preset 'best' does not exist"):
        read_settings(written(tmp_path, "preset: best"), Config(), "sensor")


def config_of_align(monkeypatch: pytest.MonkeyPatch, *options: str) -> Config:
    """The settings that `garps align` works with."""
    seen: list[Config] = []

    def align(*given: Any) -> Any:
        seen.append(given[4])
        raise ConfigError("enough")

    monkeypatch.setattr(command, "_of_images", align)
    assert command.main(["align", "a.png", "b.png", "--K", "500", "500", "320", "240", *options]) == 2
    return seen[0]


def test_all_commands_take_the_preset_that_is_asked_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, "preset: monocular\nlifting.stride: 4\n")
    expected, files = Config.preset("paper").replace({"lifting.stride": 4}), Config.preset("monocular")
    assert config_of_align(monkeypatch, "--settings", str(path), "--preset", "paper") == expected
    assert caplog.messages == [f"the preset is paper, as asked for, and not monocular, which {path} names"]
    assert config_of_align(monkeypatch, "--settings", str(path)) == files.replace({"lifting.stride": 4})
    assert replay._configured("paper", None, path, []) == expected
    assert run.config_for("sensor", path, []) == Config().replace(
        {"reconstruction.method": "rgbd", "lifting.stride": 4}
    )
