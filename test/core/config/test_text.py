# SPDX-License-Identifier: Apache-2.0
"""Settings in a YAML file: the same for the command, the replay, the benches and the node; mistakes are one line."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from garps_core import Config, ConfigError
from garps_core.cli import command
from garps_core.config import PRESETS
from garps_core.config.text import MAX_BYTES, read_settings, write_settings


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
    assert (tmp_path / "a.yaml").read_text().startswith("# chosen by hand\n# for a test\n/**:\n")


@given(value=st.floats(1e-3, 1e6), tiny=st.floats(0, 1))
def test_numbers_keep_every_digit(tmp_path_factory: pytest.TempPathFactory, value: float, tiny: float) -> None:
    path = tmp_path_factory.getbasetemp() / "numbers.yaml"
    write_settings(path, "default", {"alignment.effective_measurements": value, "lifting.noise_floor_m": tiny})
    found = read_settings(path)
    assert (found.alignment.effective_measurements, found.lifting.noise_floor_m) == (value, tiny)


def test_plain_and_nested_files(tmp_path: Path) -> None:
    base = Config.preset("monocular")
    plain = read_settings(written(tmp_path, "lifting.stride: 4\nalignment.effective_measurements: 7\n"), base)
    nested = read_settings(written(tmp_path, "lifting: {stride: 4}\nalignment:\n  information: 7\n"), base)
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


def test_the_node_takes_the_same(tmp_path: Path) -> None:
    """The names of a written file are parameters of the node, of the types that it wants."""
    from garps_ros.parameters.parameter import parameters, settings_from

    write_settings(tmp_path / "a.yaml", "monocular", {"alignment.effective_measurements": 6.0, "lifting.stride": 4})
    found = read_settings(tmp_path / "a.yaml")
    values = {parameter.name: parameter.default for parameter in parameters("monocular")}
    _, config = settings_from(values | {"alignment.effective_measurements": 6.0, "lifting.stride": 4})
    assert config == found and "monocular" in PRESETS
