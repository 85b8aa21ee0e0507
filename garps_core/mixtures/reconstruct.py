# SPDX-License-Identifier: Apache-2.0
"""View -> Mixture: from the sensor's depth, from a depth network's, or by Flash3D on either.

    view -> with_depth: the sensor's, a depth network's of all views in one pass, or that of the two-view network which
            also gives the start pose
         -> mixture_of: lifted pixel by pixel, or two Gaussians per pixel by Flash3D; labels where asked for

`config.reconstruction.method` chooses. Every function takes the `Networks` that it asks; without any it loads its own
for the one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from garps_core.checks import Float32Array
from garps_core.config import Config, depth_networks
from garps_core.config.combinations import check_settings
from garps_core.errors import ConfigError, InputError, ReconstructionError, WeightsError
from garps_core.mixtures.frustum import MIN_COMPONENTS
from garps_core.mixtures.lift import lift
from garps_core.models.in_use import Networks, dtype_of
from garps_core.point_maps import PairMaps, own_depth
from garps_core.types import Mixture, View


def reconstruct(view: View, config: Config | None = None, networks: Networks | None = None) -> Mixture:
    """The mixture of one view, in its own camera frame.

    Args:
        view: image and intrinsics; depth, where `config.reconstruction.method` wants the sensor's.
        config: `reconstruction` and `lifting` are used; the default preset when None.
        networks: keeps what it loads for the next call; None = load what is needed for this call alone.
    Returns:
        Mixture, components along a Z-order curve (but in the published order for the paper's solver).
    Raises:
        MissingDepthError: no depth where a sensor's is wanted.
        ReconstructionError: too few usable pixels, or depth beyond the network's range.
        ConfigError: settings that do not go together.
        WeightsError: weights that are not installed, or not what they should be.
        ModelError: a network that does not fit the memory, or whose output is not finite.
        InputError: a picture too elongated for a network.
    """
    config, networks = config or Config(), networks or Networks()
    return mixture_of(with_depth([view], config, networks)[0], config, networks)


def with_depth(
    views: Sequence[View], config: Config, networks: Networks | None = None, maps: PairMaps | None = None
) -> list[View]:
    """The views with the depth that their mixtures are made of: their own, or a network's in one pass.

    Args:
        views: one or more; for a two-view network source and target.
        config: `reconstruction` is used, `start` too for a two-view network.
        networks: as for `reconstruct`.
        maps: answer of the two-view network about these two views; None = it is asked where it is needed.
    Raises:
        ReconstructionError, ConfigError, WeightsError, ModelError, InputError: as `reconstruct`.
    """
    networks, method = networks or Networks(), config.reconstruction.method
    if method == "ply":
        raise ConfigError("reconstruction.method is ply: expected mixtures from files, as `garps align a.ply b.ply`")
    if method == "two_view":
        check_settings(config)
        return _of_pair(views, config, networks, maps)
    needing = [i for i, view in enumerate(views) if view.depth is None or method in depth_networks()]
    if not needing or method == "rgbd":
        return list(views)
    check_settings(config)
    try:
        depths = networks.depths([views[i] for i in needing], config)
    except WeightsError as error:
        if method != "auto":
            raise
        raise WeightsError(f"no depth with the image, and none from a network: {error}; or give depth") from None
    found = list(views)
    for i, depth in zip(needing, depths, strict=True):
        found[i] = _given(views[i], depth)
    return found


def _of_pair(views: Sequence[View], config: Config, networks: Networks, maps: PairMaps | None) -> list[View]:
    if len(views) != 2:
        raise ConfigError(
            f"reconstruction.method is two_view, whose network looks at pairs: expected 2 views, not {len(views)}"
        )
    maps, least = maps or networks.pair_maps(views[0].rgb, views[1].rgb, config), config.start.min_confidence
    if not maps.metric:
        raise ConfigError(
            f"reconstruction.method is two_view and the points of {maps.origin} have no metres: expected mast3r"
        )
    depths = own_depth(maps, views[0], views[1], least)
    for name, depth in zip(("source", "target"), depths, strict=True):
        if (count := int(np.isfinite(depth).sum())) < MIN_COMPONENTS:
            raise ReconstructionError(
                f"{maps.origin} gives {count} of {depth.size} pixels of the {name} depth of which it is surer than "
                f"{least:g}: expected at least {MIN_COMPONENTS}. Do the pictures share anything, are the weights "
                "trained, is start.min_confidence on the network's scale?"
            )
    return [_given(view, depth) for view, depth in zip(views, depths, strict=True)]


def _given(view: View, depth: Float32Array) -> View:
    try:
        return replace(view, depth=depth)
    except InputError as error:
        raise ReconstructionError(f"the network's {error}") from None


def mixture_of(view: View, config: Config, networks: Networks | None = None) -> Mixture:
    """The mixture of a view `with_depth`. networks: as for `reconstruct`. Raises as `reconstruct`."""
    networks, settings = networks or Networks(), config.reconstruction
    mixture = None if settings.method == "flash3d" else lift(view, config.lifting)
    if mixture is not None and settings.semantics == "none":
        return mixture
    from garps_core.mixtures.flash3d import gaussians_to_mixture, predict_gaussians
    from garps_core.models.semantics import labelled

    labels = None if settings.semantics == "none" else networks.labels(view.rgb, config)
    if mixture is not None:
        return mixture if labels is None else labelled(mixture, labels, view.K)
    gaussians = predict_gaussians(networks.flash3d(config), view, settings.drop_border, dtype_of(config))
    return gaussians_to_mixture(gaussians, view, config.lifting, labels, along_curve=not config.published_order)


def mixtures_of(views: Sequence[View], config: Config, networks: Networks | None = None) -> list[Mixture]:
    """`mixture_of` each view: lifting in two threads, networks one after the other, which use all cores anyway."""
    networks = networks or Networks()
    if config.reconstruction.method == "flash3d" or config.reconstruction.semantics != "none":
        return [mixture_of(view, config, networks) for view in views]
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(partial(mixture_of, config=config, networks=networks), views))
