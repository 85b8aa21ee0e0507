# SPDX-License-Identifier: Apache-2.0
"""All settings and the presets. Settings are frozen; a typo in a name is an error.

`Config()` is the default; `Config.preset(name)` the named ones; `config.replace({"lifting.stride": 4})` a changed copy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from garps_core.config.alignment import Alignment
from garps_core.config.field import Checked, flattened, replaced, setting
from garps_core.config.ladders import NETWORK, NETWORK_SEARCH
from garps_core.config.lifting import Lifting
from garps_core.config.paper import Paper
from garps_core.config.reconstruction import Reconstruction
from garps_core.config.renamed import current
from garps_core.config.start import Start
from garps_core.errors import ConfigError


@dataclass(frozen=True)
class Config(Checked):
    """All settings, in parts; the classes of the parts describe their fields."""

    reconstruction: Reconstruction = Reconstruction()
    lifting: Lifting = Lifting()
    start: Start = Start()
    alignment: Alignment = Alignment()
    paper: Paper = Paper()
    method: str = setting(
        "garps",
        "method of alignment: garps = annealed maximum a posteriori; paper = the published objective and optimiser",
        choices=("garps", "paper"),
        expert=True,
    )
    device: str = setting("cpu", "device of the objective and of the networks: cpu, cuda, cuda:0 ...")
    dtype: str = setting("float32", "arithmetic of the objective", choices=("float32", "float64"), expert=True)
    seed: int = setting(0, "seed of the random numbers of robust estimators", low=0, high=2**31 - 1, expert=True)

    @classmethod
    def preset(cls, name: str) -> Config:
        """Return a named configuration, one of `PRESETS`. Raises ConfigError on another name."""
        if name not in PRESETS:
            raise ConfigError(f"preset {name!r} does not exist: expected one of {', '.join(PRESETS)}")
        return PRESETS[name]()

    @property
    def solves_depth_errors(self) -> bool:
        """Whether the errors of each depth map are unknowns beside the pose; the published method has none."""
        return self.alignment.depth_errors and self.method == "garps"

    @property
    def published_order(self) -> bool:
        """Whether components keep their network's order, of which the published method takes every n-th."""
        return self.method == "paper"

    def replace(self, changes: Mapping[str, Any]) -> Config:
        """Return a copy with settings changed by dotted name, e.g. {"lifting.stride": 4}. Names of old work too.

        Raises:
            ConfigError: a name that is no setting, or a value out of range.
        """
        config: Config = self
        for given, value_given in changes.items():
            name, value = current(given, value_given)
            config = replaced(config, name, name.split("."), value)
        return config

    def settings(self) -> dict[str, Any]:
        """Return every setting by dotted name, in order of definition."""
        return dict(flattened("", self))


def _structured_light() -> Config:
    """Return settings for the first Kinect and the like.

    The sigma of its depth z is 1.4 mm/m^2 z^2 (Khoshelham and Elberink 2012, 3.2) and 1 mm of rounding.
    """
    return Config(lifting=Lifting(noise_floor_m=1e-3, noise_linear=0.0, noise_quadratic_per_m=1.4e-3))


def _stereo() -> Config:
    """Return settings for active stereo such as RealSense D4xx.

    Disparity has a sigma of 0.1 px, hence depth one of z^2 0.1 / (f b), with f = 640 px and b = 50 mm. For other
    cameras set noise_quadratic_per_m to 0.1 / (f b). The scale is as good as the calibration of the baseline, 1 %.
    """
    return Config(lifting=Lifting(noise_floor_m=1e-3, noise_linear=0.0, noise_quadratic_per_m=3.1e-3, scale_sigma=0.01))


def _time_of_flight() -> Config:
    """Return settings for time-of-flight cameras: Azure Kinect, HoloLens, phones.

    Depth has a sigma of a few mm at any range (17 mm at most by the data sheets), and 1 mm more per metre.
    """
    return Config(lifting=Lifting(noise_floor_m=4e-3, noise_linear=1e-3))


def _monocular() -> Config:
    """Return settings for metric depth from one image.

    Its scale and shape are off by a few per cent and are solved for together with the pose. It is off by as much from
    one object to the next (`patch_sigma`). Matches may fit such errors by chance, so `min_inliers` is higher.
    """
    return Config(
        lifting=Lifting(noise_floor_m=6e-3, noise_linear=0.03, scale_sigma=0.03, warp_sigma=0.02, patch_sigma=0.03),
        start=Start(min_inliers=10),
        alignment=Alignment(
            ladder=NETWORK,
            search_ladder=NETWORK_SEARCH,
            depth_errors=True,
            brightness_measurements=0.04,
            effective_measurements=5.0,
        ),
    )


def _paper() -> Config:
    """Return the published objective, hyperparameters and optimiser (Li and Campbell, GARPS)."""
    return Config(lifting=Lifting(weighting="equal"), method="paper")


def _paper_full() -> Config:
    """Return the whole published pipeline: MASt3R, Flash3D on Depth Anything V2, Mask2Former. For research only."""
    return _paper().replace(
        {"start.method": "mast3r", "reconstruction.method": "flash3d", "reconstruction.semantics": "m2f"}
    )


def _mast3r() -> Config:
    """Return settings for two images alone: MASt3R gives start pose and both depth maps. Non-commercial.

    The network sees both views at once, so the depth maps agree from place to place (`patch_sigma` 0).
    """
    of_pair = {"start.method": "mast3r", "reconstruction.method": "two_view"}
    return _monocular().replace(of_pair | {"lifting.patch_sigma": 0.0, "start.min_inliers": Start().min_inliers})


def _demo_net() -> Config:
    """Return settings for the network in the package, a demonstration that knows generated rooms only.

    Its depth is off by 10 % in scale, half of that in both maps alike, and by 15 % in shape (docs/demo_net.md), several
    times more than `monocular` assumes. Mixtures therefore weigh less, and features mostly constrain the pose across
    epipolar lines.
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
            "alignment.effective_measurements": 0.3,
            "alignment.brightness_measurements": 0.02,
            "alignment.occlusion_ratio": 0.5,
        }
    )


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
"""Presets by name; "default" and "sensor" are the same."""
