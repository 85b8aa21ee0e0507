# SPDX-License-Identifier: Apache-2.0
"""Settings as text: NAME=VALUE on a command line, and YAML files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from garps_core.config.config import Config
from garps_core.config.renamed import LOG, current
from garps_core.errors import ConfigError

MAX_BYTES = 2**20
"""Largest size of a settings file."""
OF_A_NODE = "ros__parameters"
"""Key of a node's parameters in a file for ROS."""


def changed_config(config: Config, changes: Iterable[str]) -> Config:
    """Return a copy with changes like "lifting.stride=4". Raises ConfigError on a typo or a value out of range."""
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals:
            raise ConfigError(f"--set {change!r} has no '=': expected NAME=VALUE, e.g. --set lifting.stride=4")
        name, text = current(name, text)
        config = config.replace({name: _value(name, text, config.settings().get(name))})
    return config


def _value(name: str, text: str, current: Any) -> Any:
    """Convert text to the type of the present value; Config itself checks names and ranges."""
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


def configured(
    preset: str | None, file: Path | None, changes: Iterable[str], default: Callable[[Config], str]
) -> Config:
    """Return the settings that a command line asks for: preset, then file, then single changes above these.

    Args:
        preset: name of the preset; None = the one that the file names, else `default`.
        file: settings file, see `read_settings`; None = none.
        changes: single settings, NAME=VALUE.
        default: gives the name of the preset that goes with the settings as they are without one.

    Raises:
        ConfigError: no such preset, file or setting, or a value out of range.
    """
    changes = list(changes)

    def changed(base: Config) -> Config:
        return changed_config(base if file is None else read_settings(file, base, preset), changes)

    return changed(Config.preset(preset or default(changed(Config()))))


def read_settings(path: Path, config: Config | None = None, preset: str | None = None) -> Config:
    """Return the settings of a YAML file: the preset that it names, if any, and its single settings above that.

    Args:
        path: a mapping `lifting.stride: 4`, nested by the parts if need be; or the same below
            `/**: ros__parameters:`.
        config: settings that the file changes where it names no preset; the default preset when None.
        preset: name of the preset that the user has asked for beside the file, and that `config` is made from. It
            stands above one that the file names; where the two differ, that is a warning in the log.

    Raises:
        ConfigError: not such a file, a name that is no setting, or a value out of range.
    """
    named, given = _contents(path)
    try:
        if named is not None and preset is None:
            config = Config.preset(named)
        elif named is not None and preset is not None and Config.preset(named) != Config.preset(preset):
            LOG.warning(f"the preset is {preset}, as asked for, and not {named}, which {path} names")
        return (config or Config()).replace(given)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def preset_in(path: Path) -> str | None:
    """Return the preset that a settings file names, None where it names none. Raises ConfigError."""
    return _contents(path)[0]


def write_settings(path: Path, preset: str, changes: Mapping[str, Any], comment: str = "") -> None:
    """Write a file for `read_settings`; `comment` is put on top of it, line by line."""
    lines = ["# " + line for line in comment.splitlines()]
    lines += [f"preset: {preset}"]
    lines += [f"{name}: {_yaml(value)}" for name, value in changes.items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and "." not in repr(value):  # YAML takes 1e-05 for a text
        return repr(value).replace("e", ".0e")
    return repr(value) if isinstance(value, (int, float)) else f'"{value}"'


def _contents(path: Path) -> tuple[str | None, dict[str, Any]]:
    """Return the preset that a settings file names, and its settings by dotted name."""
    settings = dict(_flat("", _mapping(path)))
    named = settings.pop("preset", None)
    return None if named is None else str(named), settings


def _mapping(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(f"{path} has {path.stat().st_size} bytes: expected settings, at most {MAX_BYTES}")
        content = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ConfigError(f"cannot read settings from {path}: {reason}") from None
    if isinstance(content, dict) and len(content) == 1:
        (only,) = content.values()
        if isinstance(only, dict) and set(only) == {OF_A_NODE}:
            content = only[OF_A_NODE]
    if not isinstance(content, dict):
        raise ConfigError(f"{path} holds {type(content).__name__}: expected lines like `lifting.stride: 4`")
    return content


def _flat(prefix: str, part: Mapping[Any, Any]) -> Iterable[tuple[str, Any]]:
    for name, value in part.items():
        yield from _flat(f"{prefix}{name}.", value) if isinstance(value, dict) else [(f"{prefix}{name}", value)]
