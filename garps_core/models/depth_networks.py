# SPDX-License-Identifier: Apache-2.0
"""Depth networks by name: those of this package, and those that other distributions add (docs/extending.md).

A network of this package is one file with a `DepthNetwork` and one line in `config.reconstruction.DEPTH_NETWORKS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any, Generic, TypeVar

import numpy as np

from garps_core.checks import Float32Array
from garps_core.config import Config, Reconstruction, depth_networks
from garps_core.config.reconstruction import DEPTH_NETWORKS, DEPTH_PLUGINS, installed_depth_networks
from garps_core.errors import ConfigError, GarpsError, ModelError
from garps_core.plugins import foreign, origin, told
from garps_core.types import View
from garps_core.weights.store import default

N = TypeVar("N")
DEFAULT = "depth_anything_v2"
"""Name of the network that the methods `auto` and `flash3d` take depth from."""


@dataclass(frozen=True)
class DepthNetwork(Generic[N]):
    """A network that gives metric depth of single views.

    Args:
        description: a few words for lists of networks.
        load: (weights, scene, device) -> the network, ready on that device. `weights` and `scene` are
            `reconstruction.depth_weights` and `reconstruction.scene`; "" and "any" leave the choice to the network.
            The network is kept until one of the three changes.
        depths: (network, views, settings) -> depth of each view along its optical axis, HxW float32 metres, finite,
            0 = unknown. `reconstruction.depth_scale` is applied to it afterwards.
        preset: name of the preset that goes with its errors.
        warning: a limitation that every user must know; it is logged, and printed with every estimate.
        weights_kind: kind of its weights in `garps weights list`, "" = none of them.
    """

    description: str
    load: Callable[[str, str, str], N]
    depths: Callable[[N, Sequence[View], Reconstruction], Sequence[Float32Array]]
    preset: str = "monocular"
    warning: str = ""
    weights_kind: str = ""


def network_name(settings: Reconstruction) -> str:
    """Return the name of the depth network that these settings ask where a view needs depth."""
    return settings.method if settings.method in depth_networks() else DEFAULT


def depth_network(name: str) -> DepthNetwork[Any]:
    """Return the depth network of that name, without its weights.

    Raises ConfigError where none is installed under this name, or its distribution cannot be imported.
    """
    if name in DEPTH_NETWORKS:
        own: DepthNetwork[Any] = EntryPoint(name, DEPTH_NETWORKS[name], DEPTH_PLUGINS).load()
        return own
    there = installed_depth_networks()
    if name not in there:
        raise ConfigError(f"depth network {name!r} is not installed: expected one of {', '.join(depth_networks())}")
    with foreign(f"the depth network {_told(name)} cannot be imported; update or remove it", ConfigError):
        found: DepthNetwork[Any] = there[name].load()
    if not isinstance(found, DepthNetwork):
        raise ConfigError(
            f"the depth network {_told(name)} is an object of class {type(found).__name__}: expected a DepthNetwork. "
            "docs/extending.md shows how to write one"
        )
    return found


def load_network(name: str, weights: str, scene: str, device: str) -> Any:
    """Load a depth network onto a device; its warning is logged by the caller.

    Raises ConfigError for any exception in another distribution; errors of GARPS pass unchanged.
    """
    network = depth_network(name)
    with foreign(f"the depth network {_told(name)} cannot be loaded; see its documentation", ConfigError):
        return network.load(weights, scene, device)


def metric_depths(name: str, loaded: Any, views: Sequence[View], settings: Reconstruction) -> list[Float32Array]:
    """Depth of each view, HxW float32 m along z, by a loaded network.

    Raises ModelError for any exception in another distribution, and for results that are not finite float32 arrays of
    the views' sizes; errors of GARPS pass unchanged.
    """
    with foreign(f"the depth network {_told(name)} failed", ModelError):
        found = list(depth_network(name).depths(loaded, views, settings))
    if len(found) != len(views):
        raise ModelError(
            f"the depth network {_told(name)} returned {len(found)} maps: expected {len(views)}, one per view"
        )
    for view, depth in zip(views, found, strict=True):
        _check(name, view, depth)
    return [depth * np.float32(settings.depth_scale) for depth in found]


def _check(name: str, view: View, depth: Any) -> None:
    expected = view.rgb.shape[:2]
    if not isinstance(depth, np.ndarray) or depth.shape != expected or depth.dtype != np.float32:
        given = f"{depth.dtype} {depth.shape}" if isinstance(depth, np.ndarray) else type(depth).__name__
        raise ModelError(
            f"the depth network {_told(name)} returned {given}: expected an array float32 {expected}, metres"
        )
    if not np.isfinite(depth).all():
        raise ModelError(f"the depth of the depth network {_told(name)} is not finite: expected metres, 0 = unknown")


def _told(name: str) -> str:
    """Name of a depth network, with its distribution if that is another one."""
    point = installed_depth_networks().get(name)
    return name if point is None else told(point)


def listed() -> list[tuple[str, str]]:
    """Name and description of every depth network; of one that cannot be imported the error."""
    return [(name, _described(name)) for name in depth_networks()]


def _described(name: str) -> str:
    try:
        network = depth_network(name)
    except GarpsError as error:
        return str(error)
    by = origin(installed_depth_networks().get(name))
    return "; ".join(text for text in (network.description, network.warning, by) if text)


def preset_for(method: str, with_depth: bool) -> str:
    """Return the name of the preset that goes with `reconstruction.method`, for views that bring depth or do not.

    A depth network that is asked for by name brings its own. Raises ConfigError as `depth_network`.
    """
    if method in depth_networks():
        return depth_network(method).preset
    return "default" if with_depth else "monocular"


def presets() -> dict[str, str]:
    """Preset of every depth network that can be imported, by name."""
    found = {}
    for name in depth_networks():
        try:
            found[name] = depth_network(name).preset
        except GarpsError:
            continue
    return found


def depth_from(views: Sequence[View], config: Config) -> str:
    """Return the source of the depth of the views' mixtures, for people: "given", or a network with its warning."""
    method = config.reconstruction.method
    if method == "two_view":
        return config.start.method
    there = all(view.depth is not None for view in views)
    if method == "rgbd" or (there and method not in depth_networks()):
        return "given"
    name = network_name(config.reconstruction)
    warning = depth_network(name).warning
    return f"{name}, {warning}" if warning else name


def with_weights(settings: Reconstruction) -> str:
    """Describe the depth network of the settings: with its warning, else its weights, else its description.

    Raises WeightsError where weights of the list are needed and none are installed.
    """
    name = network_name(settings)
    network, weights = depth_network(name), settings.depth_weights
    if network.weights_kind and not weights:
        weights = default(network.weights_kind, "" if settings.scene == "any" else settings.scene).name
    return f"{name} ({network.warning or (f'weights {weights}' if weights else network.description)})"
