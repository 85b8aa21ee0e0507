# SPDX-License-Identifier: Apache-2.0
"""Settings as text, NAME=VALUE, to the type each setting has."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from garps_core.config import Config
from garps_core.errors import ConfigError


def changed_config(config: Config, changes: Iterable[str]) -> Config:
    """A copy of `config` with changes like "lifting.stride=4". Raises ConfigError on a typo or a value out of range."""
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals:
            raise ConfigError(f"--set {change!r} has no '=': expected NAME=VALUE, e.g. --set lifting.stride=4")
        config = config.replace({name: _value(name, text, config.settings().get(name))})
    return config


def _value(name: str, text: str, current: Any) -> Any:
    """Text to the type of the present value; Config itself checks names and ranges."""
    if isinstance(current, bool):
        if text.lower() not in ("true", "false"):
            raise ConfigError(f"{name} is {text!r}: expected true or false")
        return text.lower() == "true"
    if isinstance(current, tuple):
        raise ConfigError(f"{name} cannot be set as text: expected a number or a word setting")
    if isinstance(current, (int, float)):
        try:
            return type(current)(text)
        except ValueError:
            kind = "an integer" if isinstance(current, int) else "a number"
            raise ConfigError(f"{name} is {text!r}: expected {kind}") from None
    return text
