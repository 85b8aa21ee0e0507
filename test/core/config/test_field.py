# SPDX-License-Identifier: Apache-2.0
"""A setting knows its meaning, unit, range and choices; a settings class checks its own fields."""

import re
from dataclasses import dataclass, fields
from typing import Any

import pytest

from garps_core.config import Config, Rung
from garps_core.config.field import Checked, description, setting
from garps_core.errors import ConfigError
from garps_ros.parameters.settings import NodeSettings

INSTALLED = ["candle"]


@dataclass(frozen=True)
class Lamp(Checked):
    kind: str = setting("candle", "kind of the lamp", choices=lambda: tuple(INSTALLED))


def test_choices_may_be_a_function_that_is_called_when_they_are_needed() -> None:
    (kind,) = fields(Lamp)
    with pytest.raises(ConfigError, match=r"^lamp\.kind is 'torch': expected one of candle$"):
        Lamp("torch")
    INSTALLED.append("torch")
    assert Lamp("torch").kind == "torch"
    assert description(kind)["choices"] == ("candle", "torch")


UNCLEAR = re.compile(r"\b(fit_brightness|worth|initial|says|told)\b", re.IGNORECASE)
CLASSES = (Config, *(type(f.default) for f in fields(Config) if isinstance(f.default, Checked)), Rung, NodeSettings)
SETTINGS = {f"{kind.__name__}.{f.name}": f for kind in CLASSES for f in fields(kind) if "doc" in f.metadata}
FULL_NAMES = {*Config().settings(), *(f.name for f in fields(NodeSettings))}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_text_of_a_setting_is_complete_in_itself(name: str) -> None:
    """`ros2 param describe` prints it alone."""
    f: Any = SETTINGS[name]
    text: str = f.metadata["doc"]
    words = re.findall(r"[A-Za-z0-9_]+", text.lower())
    assert text[0].isalpha() and len(words) >= 4, "a noun phrase or a sentence"
    assert words[0] not in ("of", "what", "as", "which", "so", "where", "how", "whose", "that"), "begins in the middle"
    assert not UNCLEAR.search(text)
    assert {*re.findall(r"`([^`]+)`", text)} <= FULL_NAMES, "a setting is named with its part"
    if f.default == "":
        assert "empty = " in text, "says the meaning of its default"


def test_settings_that_are_off_at_zero_say_so() -> None:
    for name in ("NodeSettings.max_rate", "Lifting.smoothing_px", "Alignment.brightness_measurements"):
        assert "0 = " in SETTINGS[name].metadata["doc"]
