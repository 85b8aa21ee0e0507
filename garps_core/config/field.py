# SPDX-License-Identifier: Apache-2.0
"""A setting is a field that knows its meaning, unit and range; a class of settings checks its own fields."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any, ClassVar

from garps_core.errors import ConfigError

Choices = tuple[str, ...] | Callable[[], tuple[str, ...]]
"""The words a text setting may take, or a function that returns them, for words that depend on what is installed."""


def setting(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: Choices = (),
    live: bool = True,
    expert: bool = False,
) -> Any:
    """Return a dataclass field with its meaning, unit and allowed values; help and parameters are generated from it.

    Args:
        default: value in the preset `default`; its type is the type of the setting.
        doc: meaning, complete in itself, as `ros2 param describe` prints it.
        unit: unit of a number, "" = none.
        low: smallest value of a number.
        high: largest value of a number.
        choices: the words a text may take, or a function that returns them; a function is called whenever they are
            needed, never at import.
        live: the setting may be changed while a node runs.
        expert: only somebody who tunes the algorithm needs the setting; it is no parameter of a node.
    """
    limits = {"unit": unit, "low": low, "high": high, "choices": choices}
    return field(default=default, metadata={"doc": doc, **limits, "live": live, "expert": expert})


def description(f: dataclasses.Field[Any]) -> dict[str, Any]:
    """Return the arguments `setting` was called with for this field, `choices` as a tuple."""
    choices = f.metadata.get("choices", ())
    return {**f.metadata, "choices": choices() if callable(choices) else choices}


_KINDS = {bool: "True or False", str: "text", tuple: "a tuple"}


class Checked:
    """Base of a dataclass of settings, which checks every field against its description and raises ConfigError.

    Errors name a field with `prefix` before it, by default the name of the class in lower case and a dot.
    """

    _prefix: ClassVar[str]

    def __init_subclass__(cls, prefix: str | None = None) -> None:
        super().__init_subclass__()
        cls._prefix = f"{cls.__name__.lower()}." if prefix is None else prefix

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            if type(value) is type(f.default) and value == f.default:
                continue  # choices that depend on what is installed are not looked up at import
            limits = description(f)
            name = self._prefix + f.name
            if limits["choices"] and value not in limits["choices"]:
                raise ConfigError(f"{name} is {value!r}: expected one of {', '.join(limits['choices'])}")
            if isinstance(f.default, (int, float)) and not isinstance(f.default, bool):
                _check_number(name, value, f.default, limits)
            elif not isinstance(value, type(f.default)):
                raise ConfigError(
                    f"{name} is {value!r:.100}: expected {_KINDS.get(type(f.default), type(f.default).__name__)}"
                )


def _check_number(name: str, value: Any, default: float, limits: Mapping[str, Any]) -> None:
    kinds = (int,) if isinstance(default, int) else (int, float)
    if not isinstance(value, kinds) or isinstance(value, bool):
        raise ConfigError(f"{name} is {value!r}: expected {'an integer' if kinds == (int,) else 'a number'}")
    low, high = limits.get("low"), limits.get("high")
    if not (value == value and (low is None or value >= low) and (high is None or value <= high)):
        raise ConfigError(f"{name} is {value}: expected between {low} and {high} {limits.get('unit', '')}".rstrip())


def flattened(prefix: str, part: Any) -> list[tuple[str, Any]]:
    """Return every setting of a dataclass, and of those inside it, by dotted name in order of definition."""
    rows: list[tuple[str, Any]] = []
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        name = prefix + f.name
        rows += flattened(name + ".", value) if isinstance(value, Checked) else [(name, value)]
    return rows


def replaced(part: Any, name: str, path: list[str], value: Any, whole: Any = None) -> Any:
    """Return a copy of `part` with the setting at `path` changed.

    Args:
        part: dataclass of settings.
        name: dotted name as the user gave it, for errors.
        path: names from `part` down to the setting.
        value: its new value.
        whole: settings among which the nearest name is looked for; `part` when None.

    Raises:
        ConfigError: no such setting, with the nearest name; or a value that is not allowed.
    """
    whole = part if whole is None else whole
    names = [f.name for f in dataclasses.fields(part)] if dataclasses.is_dataclass(part) else []
    if path[0] not in names:
        near = difflib.get_close_matches(name, [known for known, _ in flattened("", whole)], n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else "expected a name of docs/parameters.md"
        raise ConfigError(f"setting {name!r} does not exist; {hint}")
    if len(path) > 1:
        value = replaced(getattr(part, path[0]), name, path[1:], value, whole)
    return dataclasses.replace(part, **{path[0]: value})
