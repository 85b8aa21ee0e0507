# SPDX-License-Identifier: Apache-2.0
"""The ROS parameters of the live node, generated from `NodeSettings` and `garps_core.Config`. Needs no ROS."""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from garps_core.config import Config
from garps_core.config.field import description
from garps_core.errors import ConfigError
from garps_ros.parameters.settings import NodeSettings

Value = bool | int | float | str
NODE_NAMES = tuple(f.name for f in dataclasses.fields(NodeSettings))
PARTS = tuple(f.name for f in dataclasses.fields(Config) if dataclasses.is_dataclass(f.default))
"""The parts of `Config`, which stand before the dot of a setting's name."""


@dataclass(frozen=True)
class Parameter:
    """One setting: dotted name, default, and the arguments of `setting` that describe it."""

    name: str
    default: Value
    doc: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    live: bool
    expert: bool
    """The setting is no ROS parameter; it is set in a settings file."""

    @property
    def group(self) -> str:
        """The part of `Config` it belongs to, "node" for the node's own, "" for a setting of `Config` itself."""
        part, dot, _ = self.name.partition(".")
        return part if dot else "node" if self.name in NODE_NAMES else ""


def parameters(preset: str = "default", config: Config | None = None) -> list[Parameter]:
    """Return the ROS parameters: the node's own, then the estimator's that are not for experts.

    Args:
        preset: default of the parameter `preset`.
        config: defaults of the estimator's parameters; those of the preset when None.

    Raises:
        ConfigError: no such preset.
    """
    own = NodeSettings(preset=preset)
    settings = _described("", config or Config.preset(preset))
    return [*_described("", own), *(setting for setting in settings if not setting.expert)]


def expert_settings(preset: str = "default") -> list[Parameter]:
    """Return the settings of the estimator that are no ROS parameters, without the ladders, which are tables."""
    return [setting for setting in _described("", Config.preset(preset)) if setting.expert]


def _described(prefix: str, part: Any) -> Iterator[Parameter]:
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        if dataclasses.is_dataclass(value):
            yield from _described(f"{prefix}{f.name}.", value)
        elif isinstance(value, Value):
            yield Parameter(prefix + f.name, value, **description(f))


def settings_from(values: Mapping[str, Any], base: Config | None = None) -> tuple[NodeSettings, Config]:
    """Return checked settings.

    Args:
        values: the value of every parameter.
        base: settings that are no parameters; those of the preset among the values when None.

    Raises:
        ConfigError: a wrong value, a missing or an unknown name.
    """
    names = [parameter.name for parameter in parameters()]
    missing = [name for name in names if name not in values]
    if missing:
        raise ConfigError(f"parameter {missing[0]!r} has no value: expected a value for every parameter")
    for name, value in values.items():
        if name not in names:
            raise ConfigError(no_such_parameter(name, value))
    try:
        node = NodeSettings(**{name: values[name] for name in NODE_NAMES})
        config = base or Config.preset(node.preset)
        return node, config.replace({name: values[name] for name in names if name not in NODE_NAMES})
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("config.")) from None  # a parameter is plain `device`


def no_such_parameter(name: str, value: Any) -> str:
    """Return the error text for a name that is no parameter: how to set it all the same, or the nearest name."""
    names = [parameter.name for parameter in parameters()]
    if name in _expert_names():
        return (
            f"{name!r} is an expert setting and no parameter of the node. Write `{name}: {_plain(value)}` into a YAML "
            "file and give its path as the parameter settings_file"
        )
    if name in Config().settings():
        return f"parameter {name!r} does not exist: it comes with the preset; choose one by the parameter 'preset'"
    return f"parameter {name!r} does not exist; {_nearest(name, [*names, *_expert_names()])}"


def _nearest(name: str, names: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.4)
    return f"did you mean {near[0]!r}?" if near else "`ros2 param list` shows all names"


def _expert_names() -> list[str]:
    return [setting.name for setting in expert_settings()]


def _plain(value: Any) -> str:
    """Return a value as YAML."""
    return json.dumps(value) if isinstance(value, (bool, str)) else str(value)
