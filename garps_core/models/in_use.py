# SPDX-License-Identifier: Apache-2.0
"""The networks of one owner: loaded on first use and kept; they give depth, labels and point maps.

This module is light to import: the file of a network is imported when that network is asked for.
"""

from __future__ import annotations

import logging
import os
import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from garps_core.checks import Float32Array, IntArray
from garps_core.config import Config
from garps_core.config.start import TWO_VIEW
from garps_core.devices import on_device
from garps_core.errors import ConfigError
from garps_core.models.depth_networks import depth_network, load_network, metric_depths, network_name
from garps_core.point_maps import PairMaps, Picture, TwoViewModel
from garps_core.types import View
from garps_core.weights.store import weights_folder

if TYPE_CHECKING:
    from garps_core.models.flash3d import Flash3D
    from garps_core.models.mask2former import Mask2Former
    from garps_core.models.mast3r import NaverModel
    from garps_core.models.semantics import Segmenter

Made = TypeVar("Made")
LOG = logging.getLogger("garps_core")
_ALIVE: weakref.WeakSet[Networks] = weakref.WeakSet()


class Networks:
    """Networks that are loaded on first use; of every kind the last one is kept.

    Threads may share an instance: a network that several want at once is loaded once. A pickled or copied instance
    comes out empty. After a fork the child keeps the networks and gets a lock of its own; CUDA does not survive a fork.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._kept: dict[str, tuple[Hashable, Any]] = {}
        _ALIVE.add(self)

    def __reduce__(self) -> tuple[type[Networks], tuple[()]]:
        return Networks, ()

    def depths(self, views: Sequence[View], config: Config) -> list[Float32Array]:
        """Metric depth of each view, HxW float32 m along z, by the depth network of the settings, in one pass.

        Raises:
            WeightsError: none installed, or not what it should be. ModelError: too little memory, not finite.
            InputError: a picture too elongated for the network.
            ReconstructionError: most of a picture lies at the end of the network's range.
            ConfigError: the network cannot be loaded.
        """
        return metric_depths(
            network_name(config.reconstruction), self.depth_network(config), views, config.reconstruction
        )

    def labels(self, rgb: Picture, config: Config) -> IntArray:
        """Class of every pixel, HxW, by the segmentation of the settings. Raises WeightsError, ModelError."""
        from garps_core.models import mask2former, semantics

        network = self.segmenter(config)
        if isinstance(network, mask2former.Mask2Former):
            return mask2former.segment_by_masks(network, rgb)
        return semantics.segment(network, rgb, dtype=dtype_of(config))

    def pair_maps(self, source: Picture, target: Picture, config: Config) -> PairMaps:
        """Point maps of two pictures HxWx3 uint8 RGB by the two-view network of `config.start`.

        Raises:
            WeightsError: none installed, or not what they should be.
            ModelError: too little memory, values that are not finite, or whatever goes wrong in an adapter.
            ConfigError: no two-view network is chosen, or no adapter of that name is installed.
        """
        from garps_core.models.two_view_in_use import maps_by_adapter

        model = self.two_view(config)
        if config.start.method == "adapter":
            return maps_by_adapter(config.start.adapter, model, source, target)
        return model(source, target)

    def depth_network(self, config: Config) -> Any:
        """The depth network of `config.reconstruction`, on the device. Raises WeightsError, ModelError, ConfigError."""
        settings = config.reconstruction
        name = network_name(settings)
        key = name, settings.depth_weights, settings.scene, config.device

        def load() -> Any:
            if warning := depth_network(name).warning:
                LOG.warning("%s is %s", name, warning)
            return load_network(*key)

        return self._once("depth", key, load)

    def flash3d(self, config: Config) -> Flash3D:
        """Flash3D with the weights of the settings, on the device. Raises WeightsError, ModelError, ConfigError."""
        from garps_core.models import flash3d

        weights = config.reconstruction.flash3d_weights
        return on_device(self._once("flash3d", (weights,), lambda: flash3d.load_network(weights)), config.device)

    def segmenter(self, config: Config) -> Segmenter | Mask2Former:
        """The segmentation of the settings, on the device. Raises WeightsError, ModelError, ConfigError."""
        from garps_core.models import mask2former, semantics
        from garps_core.weights.load import load_weights

        settings = config.reconstruction
        key = settings.semantics, settings.semantic_weights, settings.semantic_backbone

        def load() -> Segmenter | Mask2Former:
            if settings.semantics == "m2f":
                return mask2former.mask2former_of(load_weights(settings.semantic_weights, "m2f")[1].tensors)
            return semantics.load_network(*key)

        return on_device(self._once("labels", key, load), config.device)

    def two_view(self, config: Config) -> TwoViewModel:
        """The network that `config.start.method` names, on the device. Raises as `pair_maps`."""
        from garps_core.models import two_view_in_use

        start = config.start
        if start.method not in TWO_VIEW:
            raise ConfigError(
                f"start.method is {start.method}: expected a two-view network, one of {', '.join(TWO_VIEW)}"
            )
        if start.method == "adapter":
            of_adapter = start.adapter, start.weights, config.device
            return self._once("adapter", of_adapter, lambda: two_view_in_use.load_adapter(*of_adapter))
        key = start.method, start.weights
        network, variant = self._once("two_view", key, lambda: two_view_in_use.load_network(*key))
        on_device(network, config.device)

        def model() -> NaverModel:
            return two_view_in_use.NaverModel(network, variant, dtype_of(config))

        return self._once("two_view model", (*key, config.reconstruction.network_dtype), model)

    def _once(self, kind: str, key: tuple[str, ...], load: Callable[[], Made]) -> Made:
        """Return what is kept of this kind if it was loaded under this key; else load it and keep it."""
        whole = weights_folder(), *key  # in another folder the same name is another file
        with self._lock:
            if kind not in self._kept or self._kept[kind][0] != whole:
                self._kept.pop(kind, None)  # two large networks at once may not fit
                self._kept[kind] = whole, load()
            made: Made = self._kept[kind][1]
            return made

    def _after_fork(self) -> None:
        self._lock = threading.RLock()  # whichever thread held the other is not here to release it


def _unlock_all() -> None:
    for networks in list(_ALIVE):
        networks._after_fork()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock_all)


def dtype_of(config: Config) -> torch.dtype:
    """The type that `reconstruction.network_dtype` names."""
    dtype: torch.dtype = getattr(torch, config.reconstruction.network_dtype)
    return dtype
