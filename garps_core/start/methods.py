# SPDX-License-Identifier: Apache-2.0
"""Ways to start by name: those of this package, and those that other distributions add (docs/extending.md).

A way to start of this package is one file with a function `find` (`Find`) and one line in `config.start.STARTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from typing import Any, Protocol

from garps_core.config import Config, start_methods
from garps_core.config.start import START_PLUGINS, STARTS, installed_starts
from garps_core.errors import ConfigError, GarpsError, InitialisationError, WeightsError
from garps_core.plugins import foreign, origin, told
from garps_core.point_maps import PairMaps
from garps_core.types import Prior, View

Ask = Callable[[], PairMaps]
"""A function that asks the two-view network of the settings about the pair. It raises as `Networks.pair_maps`."""
Find = Callable[[View, View, Config, Ask], Prior]
"""A way to start of this package: (source, target, config, ask) -> pose. It raises InitialisationError for no pose."""


class StartMethod(Protocol):
    """A way to start of another distribution."""

    @property
    def description(self) -> str:
        """A few words for lists of ways to start."""

    def find(self, source: View, target: View, config: Config) -> Prior:
        """Return T_target_source of the pair, metres, with its covariance.

        Args:
            source: the view whose points the pose maps; with depth, a sensor's or a network's, where it has any.
            target: the view whose frame they are mapped into.
            config: settings of the estimate.
        Raises:
            InitialisationError: the pair gives no pose; the text says why.
        """


def find_start(name: str, source: View, target: View, config: Config, ask: Ask) -> Prior:
    """Return the pose that the way to start of that name finds; the `origin` of an installed one's is its name.

    Raises:
        InitialisationError: it finds none, or an installed method fails.
        WeightsError: the weights of its network are missing, or not what they should be.
        ConfigError: the method cannot be loaded, or settings do not go together.
    """
    if name not in STARTS:
        return _by_installed(name, source, target, config)
    find: Find = EntryPoint(name, STARTS[name], START_PLUGINS).load()
    return find(source, target, config, ask)


def start_method(name: str) -> StartMethod:
    """Return the installed way to start of that name.

    Raises ConfigError where none is installed under this name, or its distribution cannot be imported.
    """
    there = installed_starts()
    if name not in there:
        raise ConfigError(f"way to start {name!r} is not installed: expected one of {', '.join(start_methods())}")
    with foreign(f"the way to start {told(there[name])} cannot be imported; update or remove it", ConfigError):
        found: Any = there[name].load()
        usable = callable(getattr(found, "find", None)) and isinstance(getattr(found, "description", None), str)
    if not usable or isinstance(found, type):
        given = f"the class {found.__name__}" if isinstance(found, type) else f"an object of {type(found).__name__}"
        raise ConfigError(
            f"the way to start {told(there[name])} is {given}: expected an object with `description` and `find`; "
            "docs/extending.md shows how to write one"
        )
    method: StartMethod = found
    return method


def _by_installed(name: str, source: View, target: View, config: Config) -> Prior:
    method, which = start_method(name), told(installed_starts()[name])
    try:
        with foreign(f"the way to start {which} failed", InitialisationError):
            found: Any = method.find(source, target, config)
    except (InitialisationError, WeightsError, ConfigError):
        raise
    except GarpsError as failure:  # e.g. a Prior whose covariance is not positive definite
        raise InitialisationError(f"the way to start {which} failed: {failure}") from failure
    if not isinstance(found, Prior):
        raise InitialisationError(f"the way to start {which} returned {type(found).__name__}: expected a Prior")
    return replace(found, origin=name)


def listed() -> list[tuple[str, str]]:
    """Return name and description of every installed way to start; of one that cannot be imported the error."""
    return [(name, _described(name, point)) for name, point in installed_starts().items()]


def _described(name: str, point: EntryPoint) -> str:
    try:
        description = start_method(name).description
    except GarpsError as error:
        return str(error)
    return "; ".join(text for text in (description, origin(point)) if text)
