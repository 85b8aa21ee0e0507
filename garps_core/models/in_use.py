# SPDX-License-Identifier: Apache-2.0
"""The networks that are in use: found by name or file, loaded once, asked for depth, Gaussians or labels."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from garps_core.checks import Float32Array, IntArray
from garps_core.config import Config, Reconstruction
from garps_core.devices import checked_device
from garps_core.errors import ModelError, ReconstructionError, WeightsError
from garps_core.models import demo_net, mask2former, semantics
from garps_core.models.depth_anything import DepthAnythingV2, RGBImage, built_from, depth_of, focal_factors
from garps_core.models.flash3d import Flash3D, flash3d_network, flash3d_tensors
from garps_core.types import View
from garps_core.weights.manifest import BY_NAME, PERMISSIVE, licence_of, named, of_file, range_of
from garps_core.weights.reader import Tensors, read_tensors
from garps_core.weights.store import default, installed, weights_folder

AT_THE_END = 0.98
"""Share of the network's largest depth from which on a pixel is as far as the network can say."""

DTYPE = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
LOG = logging.getLogger("garps_core")
Made = TypeVar("Made")
Network = TypeVar("Network", bound=nn.Module)
_LOCK = threading.RLock()


def depths(views: Sequence[View], config: Config) -> list[Float32Array]:
    """Metric depth of each view, HxW float32 m along z, by the depth network of the settings, in one pass.

    Raises:
        WeightsError: none installed, or not what it should be. ModelError: too little memory, not finite.
        InputError: a picture too elongated for the network.
        ReconstructionError: most of a picture lies at the end of the network's range.
    """
    settings = config.reconstruction
    network = on_device(depth_network_of(settings), config.device)
    if isinstance(network, demo_net.DemoNet):
        return [depth * np.float32(settings.depth_scale) for depth in demo_net.depth_of(network, views)]
    images = [view.rgb for view in views]
    fx = [float(view.K[0, 0]) for view in views] if settings.focal_correction else None
    found = depth_of(network, images, depth_scale=settings.depth_scale, fx=fx, dtype=dtype_of(config))
    largest = network.max_depth * settings.depth_scale * focal_factors(images, fx)
    for view, depth, largest_m in zip(views, found, largest, strict=True):
        _check_range(view, depth, float(largest_m))
    return found


def _check_range(view: View, depth: Float32Array, largest_m: float) -> None:
    far = float(np.mean(depth >= AT_THE_END * largest_m))
    if far > 0.5:
        raise ReconstructionError(
            f"{far:.0%} of the network's depth of {view.frame_id or 'a view'} is {largest_m:g} m, all it can say: "
            "expected rooms for indoor weights, streets for outdoor ones, and no relative model's"
        )


def labels(rgb: RGBImage, config: Config) -> IntArray:
    """Class of every pixel, HxW, by the segmentation of the settings. Raises WeightsError, ModelError."""
    settings = config.reconstruction
    network = on_device(
        segmenter(settings.semantics, settings.semantic_weights, settings.semantic_backbone), config.device
    )
    if isinstance(network, mask2former.Mask2Former):
        return mask2former.segment_by_masks(network, rgb)
    return semantics.segment(network, rgb, dtype=dtype_of(config))


def dtype_of(config: Config) -> torch.dtype:
    """What the networks compute in."""
    return DTYPE[config.reconstruction.network_dtype]


def on_device(network: Network, device: str) -> Network:
    """The network, moved there. Raises ConfigError for a device that is not there, ModelError where it does not fit."""
    try:
        return network.to(checked_device(device))
    except torch.cuda.OutOfMemoryError as error:
        raise ModelError(
            f"out of memory on {device} for the weights of {type(network).__name__}: expected them to fit; free some, "
            f"choose a smaller network, or use the CPU ({error})"
        ) from None


def once(load: Callable[..., Made]) -> Callable[..., Made]:
    """Keep the last network that was loaded so; two threads that want it at once load it once."""
    kept = lru_cache(maxsize=1)(lambda folder, *given: load(*given))

    def under_lock(*given: str) -> Made:
        with _LOCK:
            return kept(weights_folder(), *given)  # in another folder "" is another file

    return under_lock


def depth_network_of(settings: Reconstruction) -> DepthAnythingV2 | demo_net.DemoNet:
    """The depth network that the settings ask for. Raises WeightsError."""
    if settings.method == "demo_net":
        return demonstration()
    return depth_network(settings.depth_weights, settings.scene)


@once
def depth_network(weights: str, scene: str) -> DepthAnythingV2:
    """Depth Anything V2 from a name, a file or, for "", what is installed; scene = any, indoor or outdoor."""
    variant = "" if scene == "any" else scene
    path, read = tensors_of(weights, "depth_anything", variant)
    return built_from(read.tensors, range_of(path.name, read.metadata, variant, "reconstruction.scene"))


@once
def demonstration() -> demo_net.DemoNet:
    """The network in the package; that it is a demonstration is told to whoever listens to the log."""
    LOG.warning("demo_net is %s", demo_net.WHAT_IT_IS)
    return demo_net.shipped()


@once
def _flash3d(weights: str) -> Flash3D:
    return flash3d_network(flash3d_tensors(tensors_of(weights, "flash3d")[1].tensors)[0])


def flash3d(weights: str, device: str) -> Flash3D:
    """Flash3D from a name, a file or, for "", what is installed; on the device."""
    return on_device(_flash3d(weights), device)


@once
def segmenter(kind: str, weights: str, backbone: str) -> semantics.Segmenter | mask2former.Mask2Former:
    """A segmentation of kind linear, ms or m2f from names, files or, for "", what is installed."""
    if kind == "m2f":
        return mask2former.mask2former_of(tensors_of(weights, "m2f")[1].tensors)
    path, head = tensors_of(weights, f"ade20k_{kind}")
    known = of_file(path.name)
    if not backbone and known is not None:
        fitting = [one.name for one in BY_NAME.values() if one.kind == "dinov2" and one.size == known.size]
        backbone = next(filter(installed, fitting), fitting[0])
    return semantics.segmenter_of(tensors_of(backbone, "dinov2")[1].tensors, head.tensors)


def tensors_of(weights: str, kind: str, variant: str = "") -> tuple[Path, Tensors]:
    """Path and content of weights that are given by name or file; "" = the first that is installed.

    Licences that do not permit everything are told to whoever listens to the log.
    """
    path, found = _read(weights, kind, variant)
    licence = licence_of(path.name, found.metadata, kind)
    if licence not in PERMISSIVE:
        LOG.warning("licence of the weights %s: %s", path.name, licence)
    return path, found


def _read(weights: str, kind: str, variant: str) -> tuple[Path, Tensors]:
    name = weights or default(kind, variant).name
    if name not in BY_NAME:
        path = Path(weights).expanduser()
        if path.suffix not in (".pth", ".pt", ".safetensors"):
            named(name)  # raises, with the nearest names
        return path, read_tensors(path, kind=kind)
    entry, there = named(name), installed(name)
    if entry.kind != kind:
        raise WeightsError(f"{name} are weights of {entry.kind}: expected some of {kind}; see `garps weights list`")
    if there is None:
        raise WeightsError(f"{name} is not installed: run `garps weights fetch {name}`, or name another file")
    return there, read_tensors(there, max_bytes=entry.bytes or entry.bytes_bound, sha256=entry.sha256, kind=kind)
