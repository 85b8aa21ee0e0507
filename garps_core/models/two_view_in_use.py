# SPDX-License-Identifier: Apache-2.0
"""The two-view network that is in use: found by name, loaded once, asked once per pair."""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib.metadata import entry_points

from garps_core.config import Config
from garps_core.config.start import TWO_VIEW
from garps_core.errors import ConfigError, GarpsError, InputError, ModelError, WeightsError
from garps_core.models.in_use import DTYPE, on_device, once, tensors_of
from garps_core.models.mast3r import NaverModel, digest
from garps_core.models.two_view import TwoView, built_from
from garps_core.point_maps import PairMaps, Picture, TwoViewModel
from garps_core.weights.manifest import of_file

ADAPTERS = "garps_core.two_view"
"""Entry points of installed packages in this group are adapters: `NAME = "package.module:load"`."""


class _Asked:
    """The pair that was asked about last, and the answer: depth, start pose and intrinsics all want the same."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._answer: tuple[TwoViewModel, bytes, PairMaps] | None = None

    def __call__(self, model: TwoViewModel, source: Picture, target: Picture) -> PairMaps:
        key = digest(source) + digest(target)
        with self._lock:
            if self._answer is None or self._answer[0] is not model or self._answer[1] != key:
                self._answer = None  # it would keep a network alive that is no longer asked
                self._answer = model, key, model(source, target)
            return self._answer[2]


_ASKED = _Asked()


def pair_maps(source: Picture, target: Picture, config: Config) -> PairMaps:
    """What the two-view network of `config.start` says of two pictures HxWx3 uint8 RGB.

    Raises:
        WeightsError: none installed, or not what they should be.
        ModelError: too little memory, values that are not finite, or whatever goes wrong in an adapter.
        ConfigError: no two-view network is chosen, or no adapter of that name is installed.
    """
    model = two_view_model(config)
    if config.start.method != "adapter":
        return _ASKED(model, source, target)
    name = config.start.adapter
    try:
        found = _ASKED(model, source, target)
    except (ConfigError, InputError, WeightsError):
        raise
    except Exception as error:
        raise ModelError(f"the adapter {name!r} failed ({_told(error)})") from error
    if not isinstance(found, PairMaps):
        raise ModelError(f"the adapter {name!r} returned an object of class {type(found).__name__}: expected PairMaps")
    return found


def two_view_model(config: Config) -> TwoViewModel:
    """The network that `config.start.method` names, loaded, on the device. Raises as `pair_maps`."""
    method = config.start.method
    if method not in TWO_VIEW:
        raise ConfigError(f"start.method is {method}: expected a two-view network, one of {', '.join(TWO_VIEW)}")
    if method == "adapter":
        return _adapter(config.start.adapter, config.start.weights, config.device)
    model = _model(method, config.start.weights, config.reconstruction.network_dtype)
    on_device(model.network, config.device)
    return model


@once
def _model(kind: str, weights: str, dtype: str) -> NaverModel:
    network, variant = _network(kind, weights)
    return NaverModel(network, variant, DTYPE[dtype])


@once
def _network(kind: str, weights: str) -> tuple[TwoView, str]:
    path, read = tensors_of(weights, kind)
    known = of_file(path.name)
    network = built_from(read.tensors)
    if (network.architecture.descriptors > 0) != (kind == "mast3r"):
        raise WeightsError(f"{path} holds {network.architecture.name}: expected weights of {kind}, start.method")
    return network, known.variant if known is not None else read.metadata.get("variant", "")


@once
def _adapter(name: str, weights: str, device: str) -> TwoViewModel:
    there = {point.name: point for point in entry_points(group=ADAPTERS)}
    if name not in there:
        raise ConfigError(
            f"start.adapter is {name!r}: expected the name of an installed adapter, one of "
            f"{', '.join(sorted(there)) or 'none there are'}; docs/two_view_models.md shows how to write one"
        )
    try:
        load: Callable[[str, str], TwoViewModel] = there[name].load()
        return load(weights, device)
    except GarpsError:
        raise
    except Exception as error:  # whatever is wrong with a package of somebody else's, or with its weights
        raise ConfigError(f"the adapter {name!r} ({there[name].value}) cannot be loaded: {_told(error)}") from error


def _told(error: Exception) -> str:
    return str(error) if isinstance(error, GarpsError) else f"{type(error).__name__}: {error}"
