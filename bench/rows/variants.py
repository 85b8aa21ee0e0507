# SPDX-License-Identifier: Apache-2.0
"""GARPS as it is, with a part left out, or with a part added.

The published ablations are `garps-labels` against `garps` (segmentation; only where the truth has labels: an oracle's),
`garps-isotropic` and `garps-no-colour`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bench.pairs.pair import Pair
from bench.rows.row import GARPS
from garps_core import Config, Mixture, PoseEstimate, Prior, Status
from garps_core.align import NETWORKS
from garps_core.errors import GarpsError, InitialisationError
from garps_core.mixture_alignment import best_alignment
from garps_core.mixtures.reconstruct import mixtures_of, with_depth
from garps_core.models.semantics import labelled
from garps_core.start.initialise import initialise

GARPS_NO_FEATURES = "garps-no-features"
GARPS_PAPER = "garps-paper"
VAGUE = 1e4
"""Factor on the start's covariance that leaves it next to no weight."""


@dataclass(frozen=True)
class Variant:
    """A change of GARPS: settings, by name or from those there are; the mixtures; whether the start is believed, and is
    that of GARPS as it is, although settings that it depends on are changed."""

    what: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    settings: Callable[[Config], Config] = lambda config: config
    mixture: Callable[[Mixture], Mixture] = lambda mixture: mixture
    believes_start: bool = True
    same_start: bool = False
    labels: bool = False

    def config(self, config: Config) -> Config:
        """The settings of this variant."""
        return self.settings(config).replace(self.changes)


def isotropic(mixture: Mixture) -> Mixture:
    """Every component as a ball of the same volume."""
    variance = np.cbrt(np.linalg.det(mixture.covariances.astype(np.float64)))
    balls = variance[:, None, None] * np.eye(3)
    return replace(mixture, covariances=balls.astype(mixture.covariances.dtype))


def without_frustum(mixture: Mixture) -> Mixture:
    """Nothing is known of what its camera could see, nor its brightness."""
    return replace(mixture, frustum=None)


def last_rung(config: Config) -> Config:
    """Only the finest rung of each ladder."""
    settings = config.alignment
    ladders = {"ladder": settings.ladder[-1:], "search_ladder": settings.search_ladder[-1:]}
    return replace(config, alignment=replace(settings, **ladders))


def as_published(config: Config) -> Config:
    """The paper's method with its own settings for lifting and alignment."""
    published = Config.preset("paper")
    parts = {name: getattr(published, name) for name in ("method", "lifting", "alignment", "paper")}
    return replace(config, **parts)


VARIANTS: dict[str, Variant] = {
    GARPS: Variant("as it is"),
    GARPS_NO_FEATURES: Variant("no features", {"start.features": False}),
    "garps-labels": Variant("pairs of different true labels count less", labels=True),
    "garps-isotropic": Variant("balls of the same volume", mixture=isotropic),
    "garps-no-colour": Variant(
        "neither colour nor brightness", {"alignment.colour_variance": 100.0, "alignment.brightness_measurements": 0.0}
    ),
    "garps-no-brightness": Variant("no brightness in the objective", {"alignment.brightness_measurements": 0.0}),
    "garps-equal-weights": Variant("every pixel counts the same, not the area it sees", {"lifting.weighting": "equal"}),
    "garps-no-visibility": Variant("neither visibility nor brightness", mixture=without_frustum),
    "garps-no-annealing": Variant("the finest rung only", settings=last_rung),
    "garps-no-prior": Variant("the start is not believed", {"alignment.guess_uncertainty": 1e6}, believes_start=False),
    "garps-no-ray-uncertainty": Variant(
        "depth without noise", {"lifting.noise_floor_m": 5e-4, "lifting.noise_linear": 0.0}
    ),
    "garps-no-patches": Variant("depth that is off only as a whole", {"lifting.patch_sigma": 0.0}),
    GARPS_PAPER: Variant("the paper's settings, from the same start", settings=as_published, same_start=True),
    "garps-no-depth-errors": Variant("depth maps' own errors are not solved for", {"alignment.depth_errors": False}),
}
"""By the name that stands in tables."""


def variant_estimate(variant: Variant, pair: Pair, config: Config, prior: Prior | None) -> PoseEstimate:
    """The estimate of a variant from a given pose, or from whatever the settings start with. Never raises on data."""
    of_start, config = config, variant.config(config)
    if not variant.same_start:
        of_start = config
    try:
        maps = None
        if config.reconstruction.method == "two_view":
            maps = NETWORKS.pair_maps(pair.source.rgb, pair.target.rgb, config)
        views = with_depth([pair.source, pair.target], config, NETWORKS, maps)
        x, y = (variant.mixture(mixture) for mixture in mixtures_of(views, config, NETWORKS))
        if variant.labels and pair.labels is not None:
            x, y = (labelled(m, seen, v.K) for m, seen, v in zip((x, y), pair.labels, views, strict=True))
        starts = initialise(views[0], views[1], of_start, prior, NETWORKS, maps)
        if not variant.believes_start:
            starts = tuple(replace(start, covariance=VAGUE * start.covariance) for start in starts)
        return best_alignment(x, y, starts, config)
    except InitialisationError as error:
        return PoseEstimate(Status.NO_INITIAL_POSE, str(error), initial=prior)
    except GarpsError as error:  # an answer about this pair, not about the others
        return PoseEstimate(Status.NO_INITIAL_POSE, f"{type(error).__name__}: {error}", initial=prior)
