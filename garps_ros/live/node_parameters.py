# SPDX-License-Identifier: Apache-2.0
"""The parameters of a live node: declared with ranges and meaning, checked before they count, applied as one."""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Mapping
from typing import Any

import rclpy.parameter
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from garps_core.config import Config
from garps_core.devices import checked_device
from garps_core.errors import ConfigError
from garps_ros.estimates.preparation import check_method
from garps_ros.parameters.parameter import Parameter, no_such_parameter, parameters, settings_from
from garps_ros.parameters.settings import NodeSettings

Type = rclpy.parameter.Parameter.Type
TYPES = {bool: Type.BOOL, int: Type.INTEGER, float: Type.DOUBLE, str: Type.STRING}
OUR_PREFIXES = ("reconstruction.", "lifting.", "start.", "alignment.")
ALIKE = 0.83  # names at least this similar to one of ours are taken for a typo; `max_range` (0.82) is not


class NodeParameters:
    """Declares the parameters of a node and keeps the settings that they mean.

    Args:
        node: declares its other parameters before, so that they are not taken for unknown ones.
        changed: called once after every atomic change that made `node` or `config` another one.

    Raises ConfigError on a wrong type, value or name among the values given at the start (file, command line, launch).
    """

    node: NodeSettings
    config: Config

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self._changed = changed
        overrides: dict[str, rclpy.parameter.Parameter] = node._parameter_overrides
        _check_names(node, overrides)
        declared = parameters(_start_preset(overrides))
        self._values = {parameter.name: _start_value(parameter, overrides) for parameter in declared}
        self.node, self.config = settings_from(self._values)
        checked_device(self.config.device)
        check_method(self.config)
        node.declare_parameters(
            "", [(parameter.name, parameter.default, describe(parameter)) for parameter in declared]
        )
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _ours(self, changes: list[rclpy.parameter.Parameter]) -> dict[str, Any]:
        return {change.name: change.value for change in changes if change.name in self._values}

    def _judge(self, changes: list[rclpy.parameter.Parameter]) -> SetParametersResult:
        """Would the settings as a whole still be right? Changes nothing; the reason reaches whoever asked."""
        ours = self._ours(changes)
        try:
            if ours:
                check_method(settings_from(self._values | ours)[1])
            if "device" in ours:
                checked_device(ours["device"])
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[rclpy.parameter.Parameter]) -> None:
        self._values |= self._ours(changes)
        node, config = settings_from(self._values)
        if (node, config) != (self.node, self.config):
            self.node, self.config = node, config
            self._changed()


def describe(parameter: Parameter) -> ParameterDescriptor:
    """What `ros2 param describe` shows; statically typed, read-only unless live."""
    one_of = f"one of: {', '.join(parameter.choices)}" if parameter.choices else ""
    notes = "; ".join(note for note in (f"unit: {parameter.unit}" if parameter.unit else "", one_of) if note)
    descriptor = ParameterDescriptor(
        description=f"{parameter.doc} ({notes})" if notes else parameter.doc,
        additional_constraints=one_of,
        read_only=not parameter.live,
    )
    if parameter.low is None or parameter.high is None:
        return descriptor
    if isinstance(parameter.default, int):
        limits = IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=1)
        descriptor.integer_range = [limits]
    else:
        low, high = float(parameter.low), float(parameter.high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    return descriptor


def _check_names(node: Node, overrides: Mapping[str, Any]) -> None:
    """A typo among the values given at the start is an error; a name unlike all of ours is somebody else's."""
    names = [parameter.name for parameter in parameters()]
    for name in overrides:
        if name in names or node.has_parameter(name):
            continue
        if name.startswith(OUR_PREFIXES) or difflib.get_close_matches(name, names, n=1, cutoff=ALIKE):
            raise ConfigError(no_such_parameter(name, names))
        note = f"parameter {name!r} is given but is none of this node's: it has no effect here"
        node.get_logger().warning(note)


def _start_preset(overrides: Mapping[str, rclpy.parameter.Parameter]) -> str:
    (preset,) = [parameter for parameter in parameters() if parameter.name == "preset"]
    return str(_start_value(preset, overrides))


def _start_value(parameter: Parameter, overrides: Mapping[str, rclpy.parameter.Parameter]) -> Any:
    """The value given at the start, else the default. Raises ConfigError on a value of another type."""
    given = overrides.get(parameter.name)
    if given is None:
        return parameter.default
    expected = TYPES[type(parameter.default)]
    if given.type_ == expected:
        return given.value
    word = given.type_.name.lower().replace("_", " ")
    raise ConfigError(
        f"{parameter.name} is {given.value!r:.100} ({word}): expected {_an(expected.name.lower())}; "
        + _advice(given.value, parameter.default)
    )


def _an(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def _advice(value: Any, default: Any) -> str:
    """How to write the value so that it has the type of the default, or the default as an example."""
    if isinstance(default, str) and isinstance(value, (bool, int, float)):
        quoted = json.dumps(str(value).lower())
        return f"write {quoted} in a file, '{quoted}' in a shell"
    if isinstance(default, float) and type(value) is int:
        return f"write {float(value)}"
    if type(default) is int and isinstance(value, float) and value.is_integer():
        return f"write {int(value)}"
    return f"for example {json.dumps(default)}"
