# SPDX-License-Identifier: Apache-2.0
"""Every setting, once: default, range, unit and meaning. Frozen; a typo in a name is an error.

`Config()` is the default; `Config.preset(name)` the named ones; `config.replace({"lifting.stride": 4})` a changed copy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from garps_core.described import Checked, flattened, replaced, setting
from garps_core.errors import ConfigError


@dataclass(frozen=True)
class Lifting(Checked):
    """How a pixel with depth becomes a Gaussian (`reconstruct`)."""

    stride: int = setting(2, "use every n-th pixel in both image directions", unit="px", low=1, high=32)
    noise_floor_m: float = setting(1.5e-3, "sigma of one depth reading at zero range", unit="m", low=0, high=1)
    noise_linear: float = setting(3e-3, "sigma of one depth reading per metre of range", unit="m/m", low=0, high=1)
    noise_quadratic_per_m: float = setting(
        0.0,
        "sigma of one depth reading per square metre of range (triangulation)",
        unit="1/m",
        low=0,
        high=0.1,
    )
    scale_sigma: float = setting(5e-3, "relative scale error that a whole depth map may share", low=0, high=1)
    warp_sigma: float = setting(2e-3, "relative smooth warp that a depth map may have", low=0, high=1)
    pointing_sigma_rad: float = setting(
        5e-4, "error of the direction a pixel looks in (0.25 px at a focal length of 500 px)", unit="rad", low=0, high=1
    )
    edge_ratio: float = setting(
        0.04, "drop pixels whose neighbours' depth differs by more than this share", unit="", low=1e-3, high=1
    )
    min_cosine: float = setting(
        0.15, "surfaces seen flatter than this cosine are treated as seen at it", unit="", low=0.01, high=1
    )
    min_range_m: float = setting(0.1, "ignore depth below", unit="m", low=0, high=100)
    max_range_m: float = setting(20.0, "ignore depth beyond", unit="m", low=0.1, high=1000)
    smoothing_px: int = setting(5, "diameter of the edge-keeping depth filter, 0 = off", unit="px", low=0, high=15)
    footprint: float = setting(0.5, "sigma of the footprint in pixel spacings", unit="px/px", low=0.05, high=5)
    weighting: str = setting(
        "area", "component weights: surface area seen, or one per pixel", choices=("area", "equal")
    )


@dataclass(frozen=True)
class Start(Checked):
    """Where the alignment starts (`initialise`)."""

    method: str = setting(
        "auto",
        "auto = the given prior and features together, or the one there is, else identity when `identity_fallback`",
        choices=("auto", "features", "identity"),
    )
    features: bool = setting(True, "match features also where a prior is given: they check and sharpen it")
    max_contradiction: float = setting(
        5.0, "given prior and features further apart than this are two rivals", unit="sigma", low=1, high=1e6
    )
    max_features: int = setting(2000, "SIFT features per image", low=50, high=20000)
    match_ratio: float = setting(0.8, "ratio test of the feature matches", unit="", low=0.1, high=1)
    ransac_px: float = setting(3.0, "inlier threshold of the pose estimate", unit="px", low=0.1, high=50)
    min_inliers: int = setting(8, "fewer inliers than this is no pose", low=4, high=10000)
    covariance_inflation: float = setting(
        2.5, "sigmas of the feature pose are multiplied by this (calibrated)", unit="", low=0.1, high=100
    )
    identity_fallback: bool = setting(True, "start from identity when features fail and no prior is given")
    identity_sigma_m: float = setting(0.3, "sigma of the identity start, translation", unit="m", low=1e-4, high=100)
    identity_sigma_rad: float = setting(0.2, "sigma of the identity start, rotation", unit="rad", low=1e-4, high=3)


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

    solver: str = setting(
        "second_order",
        "second_order = annealed maximum a posteriori; adam = the paper's method",
        choices=("second_order", "adam"),
    )
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
    search_followed: int = setting(4, "how many beginnings of a search are followed to the end", low=1, high=100)
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
    brightness: float = setting(
        0.0, "independent measurements that a point's brightness is worth, 0 = do not sharpen by it", low=0, high=10
    )
    information: float = setting(
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
    component_stride: int = setting(1, "paper's solver: use every n-th component", low=1, high=100_000)
    opacity_threshold: float = setting(0.0, "drop components of smaller weight", low=0, high=1)
    adam_rate_translation: float = setting(9e-5, "Adam's rate for the translation", unit="m", low=0, high=1)
    adam_rate_rotation: float = setting(3e-6, "Adam's rate for the quaternion", unit="", low=0, high=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.ladder or not all(isinstance(rung, Rung) for rung in self.ladder):
            raise ConfigError(f"alignment.ladder is {self.ladder!r}: expected a tuple of at least one Rung")


@dataclass(frozen=True)
class Config(Checked):
    """All settings. See the parts for their fields."""

    lifting: Lifting = Lifting()
    start: Start = Start()
    alignment: Alignment = Alignment()
    device: str = setting("cpu", "where the objective runs: cpu, cuda, cuda:0 ...")
    dtype: str = setting("float32", "arithmetic of the objective", choices=("float32", "float64"))
    seed: int = setting(0, "seed of the robust estimators", low=0, high=2**31 - 1)

    @classmethod
    def preset(cls, name: str) -> Config:
        """A named configuration, one of `PRESETS`. Raises ConfigError on another name."""
        if name not in PRESETS:
            raise ConfigError(f"preset {name!r} does not exist: expected one of {', '.join(PRESETS)}")
        return PRESETS[name]()

    def replace(self, changes: Mapping[str, Any]) -> Config:
        """A copy with settings changed by dotted name, e.g. {"lifting.stride": 4}. Raises ConfigError on a typo."""
        config: Config = self
        for name, value in changes.items():
            config = replaced(config, name, name.split("."), value)
        return config

    def settings(self) -> dict[str, Any]:
        """Every setting by dotted name, in order of definition."""
        return dict(flattened("", self))


def _structured_light() -> Config:
    """First Kinect and its kin: sigma 1.4 mm/m^2 z^2 (Khoshelham and Elberink 2012, 3.2), and 1 mm of rounding."""
    return Config(lifting=Lifting(noise_floor_m=1e-3, noise_linear=0.0, noise_quadratic_per_m=1.4e-3))


def _stereo() -> Config:
    """Active stereo such as RealSense D4xx: 0.1 px of disparity, sigma = z^2 0.1 / (f b); f = 640 px, b = 50 mm.

    Its scale is that of the baseline's calibration, a per cent. Other cameras: noise_quadratic_per_m = 0.1 / (f b).
    """
    return Config(lifting=Lifting(noise_floor_m=1e-3, noise_linear=0.0, noise_quadratic_per_m=3.1e-3, scale_sigma=0.01))


def _time_of_flight() -> Config:
    """Azure Kinect, HoloLens, phones: a few mm at any range (data sheets: 17 mm at most), 1 mm more per metre."""
    return Config(lifting=Lifting(noise_floor_m=4e-3, noise_linear=1e-3))


def _monocular() -> Config:
    """Metric depth from one image: right to a few per cent in scale and shape, which are solved for with the pose."""
    ladder = (Rung(100.0, 1000, 20, 8), Rung(30.0, 1500, 20, 8), Rung(10.0, 2000, 15, 10), Rung(4.0, 3000, 15, 15))
    return Config(
        lifting=Lifting(noise_floor_m=6e-3, noise_linear=0.03, scale_sigma=0.03, warp_sigma=0.02),
        alignment=Alignment(
            ladder=ladder,
            search_ladder=Alignment().search_ladder[:2] + ladder[1:],
            depth_errors=True,
            brightness=0.05,
            information=5.0,
        ),
    )


def _paper() -> Config:
    """Li and Campbell, GARPS: the published objective, hyperparameters and optimiser."""
    return Config(
        lifting=Lifting(weighting="equal"),
        alignment=Alignment(
            solver="adam",
            ladder=(Rung(90.0, 1_000_000, 30, 1000),),
            colour_variance=0.4,
            component_stride=32,
            opacity_threshold=0.5,
            max_prior_sigmas=1e6,
        ),
    )


PRESETS: dict[str, Callable[[], Config]] = {
    "default": Config,
    "sensor": Config,
    "time_of_flight": _time_of_flight,
    "structured_light": _structured_light,
    "stereo": _stereo,
    "monocular": _monocular,
    "paper": _paper,
}
"""What `Config.preset` knows; "default" and "sensor" are one and the same."""
