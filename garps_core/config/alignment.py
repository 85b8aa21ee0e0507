# SPDX-License-Identifier: Apache-2.0
"""The settings of the alignment, the part of `Config` that is about the objective and how it is maximised."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config.field import Checked, setting
from garps_core.errors import ConfigError


@dataclass(frozen=True)
class Rung(Checked):
    """One step of the annealing ladder."""

    covariance_scale: float = setting(1.0, "multiplies every component covariance", low=1e-3, high=1e4)
    components: int = setting(4000, "components used per view", low=50, high=1_000_000)
    neighbours: int = setting(10, "nearest neighbours per component", low=1, high=200)
    steps: int = setting(5, "solver steps at most", low=1, high=100_000)
    blur_m: float = setting(
        0.0, "sigma of an isotropic blur of a pair of components, so that far surfaces pull", unit="m", low=0, high=100
    )
    outlier_floor: float = setting(
        0.0, "in place of `alignment.outlier_floor` when above 0; a small one lets far partners pull", low=0, high=10
    )
    occlusion_ratio: float = setting(
        0.0, "in place of `alignment.occlusion_ratio` when above 0; far off, nearly all seems hidden", low=0, high=1000
    )


@dataclass(frozen=True)
class Alignment(Checked):
    """The objective and how it is maximised (`align_mixtures`)."""

    ladder: tuple[Rung, ...] = (
        Rung(1000.0, 800, 20, 8),
        Rung(300.0, 1000, 20, 8),
        Rung(100.0, 1500, 20, 8),
        Rung(30.0, 2000, 15, 8),
        Rung(10.0, 3000, 12, 8),
        Rung(4.0, 4000, 12, 8),
        Rung(2.0, 5000, 12, 20),
    )
    search: tuple[Rung, ...] = (Rung(1000.0, 400, 40, 8, 0.3, 1e-4, 100.0),)
    search_ladder: tuple[Rung, ...] = (
        Rung(1000.0, 500, 40, 10, 0.08, 1e-4, 100.0),
        Rung(100.0, 1000, 20, 8, 0.0, 0.0, 100.0),
        Rung(100.0, 1500, 20, 8),
        Rung(30.0, 2000, 15, 8),
        Rung(10.0, 3000, 12, 8),
        Rung(4.0, 4000, 12, 8),
        Rung(2.0, 5000, 12, 20),
    )
    search_followed: int = setting(4, "how many starting_poses of a search are followed to the end", low=1, high=100)
    partner_density: float = setting(
        1.0, "partners kept for each kernel-sized patch of a mixture; at least the rung's components", low=0, high=100
    )
    colour_variance: float = setting(0.02, "variance of each colour channel (0..1)", unit="", low=1e-4, high=100)
    semantic_discount: float = setting(0.92, "weight of a pair with different labels", unit="", low=0, high=1)
    outlier_floor: float = setting(
        0.003, "outlier density, in densities of one perfect partner", unit="", low=0, high=10
    )
    depth_weight: float = setting(
        1.0,
        "1 = nearest in space; below 1 = nearest in the other camera's image, with the logarithm of depth times this",
        low=1e-3,
        high=1,
    )
    max_distance_m: float = setting(
        2.5,
        "partners further apart are ignored; has no metres to compare, and so no say, with depth_weight below 1",
        unit="m",
        low=1e-3,
        high=1000,
    )
    occlusion_ratio: float = setting(
        0.1, "drop components further behind the other view's depth than this share", unit="", low=0, high=10
    )
    depth_errors: bool = setting(
        False, "solve for what each depth map gets wrong as a whole (`lifting.scale_sigma`, `lifting.warp_sigma`)"
    )
    brightness_measurements: float = setting(
        0.0,
        "independent measurements that a point's brightness is worth, 0 = do not fit_brightness by it",
        low=0,
        high=10,
    )
    effective_measurements: float = setting(
        30.0, "effective number of independent measurements in the data term (calibrated)", low=1e-3, high=1e6
    )
    tolerance: float = setting(0.02, "a step shorter than this many of its own sigmas is converged", low=1e-9, high=1)
    min_overlap: float = setting(0.1, "smaller overlap is refused", unit="", low=0, high=1)
    max_prior_sigmas: float = setting(
        8.0, "a pose further than this from the initial one is called inconsistent", unit="sigma", low=1, high=1e6
    )
    min_support: float = setting(
        0.35, "smallest share of components that must find a partner under the final pose", low=0, high=1
    )
    guess_uncertainty: float = setting(
        0.1, "a start that leaves scene points uncertain by this share of their range is a guess", low=0, high=1e6
    )
    guess_support: float = setting(
        0.8, "smallest share of components that must find a partner when the start was a guess", low=0, high=1
    )
    min_correlation: float = setting(
        0.6, "smallest correlation of the views' brightness under the final pose, where it is known", low=-1, high=1
    )
    guess_correlation: float = setting(
        0.76, "smallest correlation of the views' brightness when the start was a guess", low=-1, high=1
    )
    enough_correlation: float = setting(
        0.95, "a search ends with the first solution under which brightness is correlated so well", low=-1, high=1
    )
    max_uncertainty: float = setting(
        0.05,
        "degenerate when scene points stay uncertain by more than this share of their range",
        low=1e-6,
        high=1e6,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.ladder or not all(isinstance(rung, Rung) for rung in self.ladder):
            raise ConfigError(f"alignment.ladder is {self.ladder!r}: expected a tuple of at least one Rung")
