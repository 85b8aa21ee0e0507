# SPDX-License-Identifier: Apache-2.0
"""Entry points of installed distributions: listed, loaded, and refused with an error that names them."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributions import write_distribution

from garps_core.errors import ConfigError, ModelError
from garps_core.plugins import foreign, installed, load

GROUP = "garps_core.test_only"
ENTRIES = {
    "zebra": "made_plugin:ANSWER",
    "absent": "no_such_module:ANSWER",
    "misspelt": "made_plugin:ANSWRE",
    "broken": "broken_plugin:ANSWER",
}


@pytest.fixture(autouse=True)
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "made_plugin.py").write_text("ANSWER = 42\n")
    (tmp_path / "broken_plugin.py").write_text("raise RuntimeError('no licence')\n")
    monkeypatch.syspath_prepend(str(write_distribution(tmp_path, "made_plugins", GROUP, ENTRIES)))
    yield tmp_path
    for module in ("made_plugin", "broken_plugin"):
        sys.modules.pop(module, None)


def test_a_list_is_sorted_and_imports_nothing() -> None:
    assert list(installed(GROUP)) == sorted(ENTRIES)
    assert not {"made_plugin", "broken_plugin"} & set(sys.modules)
    assert installed("garps_core.nobody") == {}


def test_an_object_is_loaded_by_name() -> None:
    assert load(GROUP, "zebra", "animal") == 42


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lion", r"^animal 'lion' is not installed: expected one of absent, broken, misspelt, zebra\. See docs/ext"),
        ("absent", r"^the animal 'absent' \(no_such_module:ANSWER\) cannot be loaded: ModuleNotFoundError: "),
        ("misspelt", r"^the animal 'misspelt' \(made_plugin:ANSWRE\) cannot be loaded: AttributeError: "),
        ("broken", r"cannot be loaded: RuntimeError: no licence$"),
    ],
)
def test_what_cannot_be_loaded_is_a_mistake_of_the_settings(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load(GROUP, name, "animal")


def test_an_empty_group_says_that_it_is_empty() -> None:
    with pytest.raises(ConfigError, match=r"expected an installed one, and there is none\. See elsewhere\.md"):
        load("garps_core.nobody", "lion", "animal", "elsewhere.md")


def test_the_first_on_the_path_wins_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = write_distribution(tmp_path / "other", "other_plugins", GROUP, {"zebra": "made_plugin:__name__"})
    monkeypatch.syspath_prepend(str(other))
    assert load(GROUP, "zebra", "animal") == "made_plugin"


def test_errors_of_garps_pass_and_others_are_wrapped() -> None:
    with pytest.raises(ModelError, match=r"^it failed: KeyError: 'a'$"), foreign("it failed", ModelError):
        raise KeyError("a")
    with pytest.raises(ConfigError, match=r"^mine$"), foreign("it failed", ModelError):
        raise ConfigError("mine")
