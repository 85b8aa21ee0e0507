# SPDX-License-Identifier: Apache-2.0
"""Every ROS parameter of the live node, generated from `NodeSettings` and `garps_core.Config`. Needs no ROS."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from garps_core.config import Config
from garps_core.config.field import description
from garps_core.errors import ConfigError
from garps_ros.parameters.settings import NodeSettings

Value = bool | int | float | str


@dataclass(frozen=True)
class Parameter:
    """One ROS parameter: dotted name, default, meaning, unit, range or choices; `live` = may change while running."""

    name: str
    default: Value
    doc: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    live: bool

    @property
    def group(self) -> str:
        """The part of `Config` it belongs to, "node" for the node's own, "" for what stands in `Config` itself."""
        part, dot, _ = self.name.partition(".")
        return part if dot else "node" if self.name in NODE_NAMES else ""


NODE_NAMES = tuple(f.name for f in dataclasses.fields(NodeSettings))


def parameters(preset: str = "default") -> list[Parameter]:
    """The node's own parameters, then the estimator's with the values of `preset` as defaults.

    The alignment's ladders are none of them: tables, they come with the preset. Raises ConfigError on another preset.
    """
    own = NodeSettings(preset=preset)
    return [*_described("", own), *_described("", Config.preset(own.preset))]


def _described(prefix: str, part: Any) -> Iterator[Parameter]:
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        if dataclasses.is_dataclass(value):
            yield from _described(f"{prefix}{f.name}.", value)
        elif isinstance(value, Value):
            yield Parameter(prefix + f.name, value, **description(f))


def settings_from(values: Mapping[str, Any]) -> tuple[NodeSettings, Config]:
    """Checked settings from the value of every parameter; what is no parameter comes from the preset among them.

    Raises ConfigError that names the parameter, its value and what was expected, also for a missing or unknown name.
    """
    names = [parameter.name for parameter in parameters()]
    missing = [name for name in names if name not in values]
    if missing:
        raise ConfigError(f"parameter {missing[0]!r} has no value: expected a value for every parameter")
    for name in values:
        if name not in names:
            raise ConfigError(no_such_parameter(name, names))
    try:
        node = NodeSettings(**{name: values[name] for name in NODE_NAMES})
        config = Config.preset(node.preset)
        return node, config.replace({name: values[name] for name in names if name not in NODE_NAMES})
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("config.")) from None  # a parameter is plain `device`


def no_such_parameter(name: str, names: Iterable[str]) -> str:
    """The error text for a name that is none of `names`, with the nearest of them."""
    if name in Config().settings():
        return f"parameter {name!r} does not exist: it comes with the preset; choose one by the parameter 'preset'"
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}?" if near else "`ros2 param list` shows all names"
    return f"parameter {name!r} does not exist; {hint}"
