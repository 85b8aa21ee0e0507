# SPDX-License-Identifier: Apache-2.0
"""The poses that two-view networks find themselves, without the alignment: GARPS' start with them."""

from __future__ import annotations

from bench.peers.features_pnp import Failure
from garps_core import Config
from garps_core.align import NETWORKS
from garps_core.checks import Float64Array
from garps_core.errors import WeightsError
from garps_core.start.initialise import initialise
from garps_core.types import View


def mast3r(source: View, target: View) -> Float64Array:
    """MASt3R's point maps alone, in its own metres."""
    return _pose(source, target, "mast3r")


def dust3r(source: View, target: View) -> Float64Array:
    """DUSt3R's point maps alone, with metres from depth."""
    return _pose(source, target, "dust3r")


def _pose(source: View, target: View, network: str) -> Float64Array:
    """The network's pose. It keeps the tokens of the last pictures: asked after GARPS, it only decodes."""
    try:
        (start,) = initialise(source, target, Config().replace({"start.method": network}), networks=NETWORKS)
    except WeightsError as error:
        raise Failure(f"weights are not installed: {error}") from None
    return start.T_target_source
