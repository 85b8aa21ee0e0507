# SPDX-License-Identifier: Apache-2.0
"""A setting knows its meaning, unit, range and choices; a settings class checks its own fields."""

from dataclasses import dataclass, fields

import pytest

from garps_core.config.field import Checked, description, setting
from garps_core.errors import ConfigError

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
