# SPDX-License-Identifier: Apache-2.0
"""Every setting, once: default, range, unit and meaning. Frozen; a typo in a name is an error.

`Config()` is the default; `Config.preset(name)` the named ones; `config.replace({"lifting.stride": 4})` a changed copy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from garps_core.alignment_settings import Alignment, Rung
from garps_core.described import Checked, flattened, replaced, setting
from garps_core.errors import ConfigError
from garps_core.reconstruction_settings import DEPTH_NETWORKS, METHODS, SCENES, Reconstruction

__all__ = [
    "DEPTH_NETWORKS",
    "METHODS",
    "PRESETS",
    "SCENES",
    "STARTS",
    "TWO_VIEW",
    "Alignment",
    "Config",
    "Lifting",
    "Reconstruction",
    "Rung",
    "Start",
    "preset_for",
]

TWO_VIEW = ("mast3r", "dust3r", "adapter")
"""Starts by a two-view network."""
STARTS = ("auto", "features", "identity", *TWO_VIEW)


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
    patch_sigma: float = setting(
        0.0, "relative error of depth that differs from place to place, too large for noise", low=0, high=1
    )
    common_scale_sigma: float = setting(
        0.0, "relative scale error that both depth maps have in common, so that no picture shows it", low=0, high=1
    )
    pointing_sigma_rad: float = setting(
        5e-4, "error of the direction a pixel looks in (0.25 px at a focal length of 500 px)", unit="rad", low=0, high=1
    )
    sigma_inflation: float = setting(
        1.0, "sigmas of what this depth says, times this: for errors of another kind (calibrated)", low=1, high=100
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
        "auto = the given prior and features together, or the one there is, else identity when `identity_fallback`; "
        "mast3r, dust3r, adapter = a two-view network, and the prior",
        choices=STARTS,
        live=False,
    )
    weights: str = setting(
        "", "of mast3r, dust3r or the adapter: a name or a file; empty = the first installed", live=False
    )
    adapter: str = setting("", "name of an installed two-view adapter (docs/two_view_models.md)", live=False)
    pose_from: str = setting(
        "maps", "a two-view network's point maps, or matches of its descriptors", choices=("maps", "matches")
    )
    scale: str = setting(
        "auto",
        "whose metres a two-view network's pose gets: its own, or the depth's; auto = its own if it has any",
        choices=("auto", "network", "depth"),
    )
    min_confidence: float = setting(
        3.0, "points of which a two-view network is less sure are not used", unit="", low=0, high=1e6
    )
    network_scale_sigma: float = setting(0.1, "relative error of a two-view network's metre", low=0, high=1)
    network_warp_sigma: float = setting(0.02, "relative smooth warp of a two-view network's points", low=0, high=1)
    focal_sigma: float = setting(0.05, "relative error of a focal length that a network has estimated", low=0, high=1)
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
class Config(Checked):
    """All settings. See the parts for their fields."""

    reconstruction: Reconstruction = Reconstruction()
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
    """Metric depth from one image: right to a few per cent in scale and shape, which are solved for with the pose.

    And off by as much from one thing to the next: matches may fit by chance what is allowed for that, so more must.
    """
    ladder = (Rung(100.0, 1000, 20, 8), Rung(30.0, 1500, 20, 8), Rung(10.0, 2000, 15, 10), Rung(4.0, 3000, 15, 15))
    return Config(
        lifting=Lifting(noise_floor_m=6e-3, noise_linear=0.03, scale_sigma=0.03, warp_sigma=0.02, patch_sigma=0.03),
        start=Start(min_inliers=10),
        alignment=Alignment(
            ladder=ladder,
            search_ladder=Alignment().search_ladder[:2] + ladder[1:],
            depth_errors=True,
            brightness=0.04,
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


def _paper_full() -> Config:
    """The published pipeline whole: MASt3R, Flash3D on Depth Anything V2, labels of Mask2Former. For research only."""
    return _paper().replace(
        {"start.method": "mast3r", "reconstruction.method": "flash3d", "reconstruction.semantics": "m2f"}
    )


def _mast3r() -> Config:
    """Two images and nothing else: MASt3R gives the initial pose and both depth maps in one pass. Non-commercial.

    Both depth maps come from one look at both views, and fit each other from place to place.
    """
    of_pair = {"start.method": "mast3r", "reconstruction.method": "two_view"}
    return _monocular().replace(of_pair | {"lifting.patch_sigma": 0.0, "start.min_inliers": Start().min_inliers})


def _demo_net() -> Config:
    """Two images by the network in the package, a demonstration that knows generated rooms only.

    Its depth is off by 10 % in scale, half of that in both maps alike, and 15 % in shape (docs/demo_net.md), several
    times what `monocular` takes for usual: mixtures count for less, features mostly across epipolar lines.
    """
    return _monocular().replace(
        {
            "reconstruction.method": "demo_net",
            "lifting.scale_sigma": 0.12,
            "lifting.warp_sigma": 0.15,
            "lifting.patch_sigma": 0.3,
            "lifting.common_scale_sigma": 0.08,
            "lifting.sigma_inflation": 2.2,
            "lifting.noise_linear": 0.1,
            "start.covariance_inflation": 5.0,
            "start.min_inliers": 15,
            "alignment.information": 0.3,
            "alignment.brightness": 0.02,
            "alignment.occlusion_ratio": 0.5,
        }
    )


def preset_for(method: str, with_depth: bool) -> str:
    """Name of the preset that goes with `reconstruction.method`, for views that bring depth or do not."""
    if method == "demo_net":
        return "demo_net"
    return "default" if with_depth else "monocular"


PRESETS: dict[str, Callable[[], Config]] = {
    "default": Config,
    "sensor": Config,
    "time_of_flight": _time_of_flight,
    "structured_light": _structured_light,
    "stereo": _stereo,
    "monocular": _monocular,
    "mast3r": _mast3r,
    "demo_net": _demo_net,
    "paper": _paper,
    "paper_full": _paper_full,
}
"""What `Config.preset` knows; "default" and "sensor" are one and the same."""
