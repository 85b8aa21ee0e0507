# SPDX-License-Identifier: Apache-2.0
"""The parameters of a live node: declared with ranges and meaning, checked before they count, applied as one."""

from __future__ import annotations

import difflib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy.parameter
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node

from garps_core.config import PRESETS, Config
from garps_core.config.renamed import LOG, current
from garps_core.config.text import preset_in, read_settings
from garps_core.devices import checked_device
from garps_core.errors import ConfigError
from garps_ros.estimates.preparation import check_method
from garps_ros.parameters.parameter import PARTS, Parameter, no_such_parameter, parameters, settings_from
from garps_ros.parameters.settings import NodeSettings, current_rectified

Type = rclpy.parameter.Parameter.Type
TYPES = {bool: Type.BOOL, int: Type.INTEGER, float: Type.DOUBLE, str: Type.STRING}
OUR_PREFIXES = tuple(f"{part}." for part in PARTS)
ALIKE = 0.83
"""Smallest similarity (0..1) to a parameter's name that counts as a typo; `max_range` has 0.82."""


class NodeParameters:
    """Declares the parameters of a node and keeps the settings that they mean.

    Args:
        node: declares its other parameters before, so that they are not taken for unknown ones.
        changed: called once after every atomic change that made `node` or `config` another one.

    Raises:
        ConfigError: a wrong type, value or name among the values given at the start (parameters file, command line,
            launch file), or in the settings file.
    """

    node: NodeSettings
    config: Config

    def __init__(self, node: Node, changed: Callable[[], None]) -> None:
        self._changed = changed
        overrides: dict[str, rclpy.parameter.Parameter] = node._parameter_overrides
        with _warnings_to(node.get_logger()):
            _rename(overrides)
            _check_names(node, overrides)
            preset, self._base = _start_settings(overrides)
        declared = parameters(preset, self._base)
        self._values = {parameter.name: _start_value(parameter, overrides) for parameter in declared}
        self.node, self.config = settings_from(self._values, self._base)
        checked_device(self.config.device)
        check_method(self.config)
        node.declare_parameters(
            "", [(parameter.name, parameter.default, describe(parameter)) for parameter in declared]
        )
        node.add_pre_set_parameters_callback(self._in_present_words)
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)
        self._logger = node.get_logger()

    def _in_present_words(self, changes: list[rclpy.parameter.Parameter]) -> list[rclpy.parameter.Parameter]:
        with _warnings_to(self._logger):
            return [_in_present_words(change) for change in changes]

    def _ours(self, changes: list[rclpy.parameter.Parameter]) -> dict[str, Any]:
        return {change.name: change.value for change in changes if change.name in self._values}

    def _judge(self, changes: list[rclpy.parameter.Parameter]) -> SetParametersResult:
        """Check the settings as they would be; changes nothing. The caller receives the reason of a refusal."""
        ours = self._ours(changes)
        try:
            if ours:
                check_method(settings_from(self._values | ours, self._base)[1])
            if "device" in ours:
                checked_device(ours["device"])
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[rclpy.parameter.Parameter]) -> None:
        self._values |= self._ours(changes)
        node, config = settings_from(self._values, self._base)
        if (node, config) != (self.node, self.config):
            self.node, self.config = node, config
            self._changed()


def describe(parameter: Parameter) -> ParameterDescriptor:
    """Return the text and limits that `ros2 param describe` shows; statically typed, read-only unless live."""
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


@contextmanager
def _warnings_to(logger: Any) -> Iterator[None]:
    """Write warnings of the estimator's settings to a logger of rclpy meanwhile."""
    handler = logging.Handler()
    handler.emit = lambda record: logger.warning(record.getMessage())  # type: ignore[method-assign]
    LOG.addHandler(handler)
    try:
        yield
    finally:
        LOG.removeHandler(handler)


def _in_present_words(given: rclpy.parameter.Parameter) -> rclpy.parameter.Parameter:
    """Return the parameter by the name and value it has now, the same object where these are the present ones."""
    name, value = current(given.name, given.value)
    if name == "rectified" and isinstance(value, (str, bool)):
        value = current_rectified(str(value))
    return given if (name, value) == (given.name, given.value) else rclpy.parameter.Parameter(name, value=value)


def _rename(overrides: dict[str, rclpy.parameter.Parameter]) -> None:
    """Put every value given at the start under the name it has now."""
    for old, given in list(overrides.items()):
        now = _in_present_words(given)
        del overrides[old]
        overrides.setdefault(now.name, now)


def _check_names(node: Node, overrides: Mapping[str, rclpy.parameter.Parameter]) -> None:
    """Refuse a typo and an expert setting among the values given at the start; note names of other nodes."""
    names = [parameter.name for parameter in parameters()]
    for name, given in overrides.items():
        if name in names or node.has_parameter(name):
            continue
        known = name.startswith(OUR_PREFIXES) or name in Config().settings()
        if known or difflib.get_close_matches(name, names, n=1, cutoff=ALIKE):
            raise ConfigError(no_such_parameter(name, given.value))
        note = f"parameter {name!r} is given but is none of this node's: it has no effect here"
        node.get_logger().warning(note)


def _start_settings(overrides: Mapping[str, rclpy.parameter.Parameter]) -> tuple[str, Config]:
    """Return the preset's name and the settings that preset and settings file make, without single parameters."""
    by_name = {parameter.name: parameter for parameter in parameters()}
    asked, file = (str(_start_value(by_name[name], overrides)) for name in ("preset", "settings_file"))
    if asked not in PRESETS:
        raise ConfigError(f"preset is {asked!r}: expected one of {', '.join(PRESETS)}")
    if not file:
        return asked, Config.preset(asked)
    path = Path(file).expanduser()
    try:
        if "preset" in overrides:
            return asked, read_settings(path, Config.preset(asked), asked)
        return preset_in(path) or asked, read_settings(path)
    except ConfigError as error:
        raise ConfigError(f"settings_file: {error}") from None


def _start_value(parameter: Parameter, overrides: Mapping[str, rclpy.parameter.Parameter]) -> Any:
    """Return the value given at the start, else the default. Raises ConfigError on a value of another type."""
    given = overrides.get(parameter.name)
    if given is None:
        return parameter.default
    expected = TYPES[type(parameter.default)]
    if given.type_ == expected:
        return given.value
    word = given.type_.name.lower().replace("_", " ")
    raise ConfigError(
        f"{parameter.name} is {given.value!r:.100} ({word}): expected {_an(expected.name.lower())}"
        + _advice(given.value, parameter.default)
    )


def _an(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"


def _advice(value: Any, default: Any) -> str:
    """Return the end of the error text: the value in the type of the default, or the default as an example."""
    if isinstance(default, str) and isinstance(value, (bool, int, float)):
        quoted = json.dumps(str(value).lower())
        return f". Write {quoted} in a file, '{quoted}' in a shell"
    if isinstance(default, float) and type(value) is int:
        return f". Write {float(value)}"
    if type(default) is int and isinstance(value, float) and value.is_integer():
        return f". Write {int(value)}"
    return f", for example {json.dumps(default)}"
