# SPDX-License-Identifier: Apache-2.0
"""The live node's own settings: subscriptions, pairing, publishing. The estimator's are `garps_core.Config`."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config import PRESETS
from garps_core.config.field import Checked, setting
from garps_core.config.renamed import warn_once
from garps_core.errors import ConfigError

RECTIFIED = ("auto", "rectified", "raw")
"""Values of the setting `rectified`."""
OLD_RECTIFIED = {"true": "rectified", "false": "raw"}
"""Earlier values of `rectified`, which work for one release."""


def current_rectified(value: str) -> str:
    """Return the present word for a value of `rectified`; the first use of an earlier one is a warning in the log."""
    word = value.lower()
    if word not in OLD_RECTIFIED:
        return value
    warn_once(f"rectified={word}", f"rectified={OLD_RECTIFIED[word]}")
    return OLD_RECTIFIED[word]


@dataclass(frozen=True)
class NodeSettings(Checked, prefix=""):
    """Settings of `pose_node`; those that are not live are fixed when the node starts. Raises ConfigError."""

    preset: str = setting(
        "default",
        "preset that the estimator's settings start from",
        choices=tuple(PRESETS),
        live=False,
    )
    settings_file: str = setting(
        "",
        "path of a YAML file with settings of the estimator, expert settings too; parameters stand above it; empty = "
        "none",
        live=False,
    )
    pairing: str = setting(
        "cameras",
        "pairs to estimate: cameras = images of two cameras at the same time, keyframe = the source camera alone, "
        "against its keyframe",
        choices=("cameras", "keyframe"),
        live=False,
    )
    image_transport: str = setting(
        "raw",
        "transport of the images; compressed = subscribe to the topic + /compressed",
        choices=("raw", "compressed"),
        live=False,
    )
    depth_transport: str = setting(
        "raw",
        "transport of the depth; if not raw, its name is added to the topic after a /",
        choices=("raw", "compressed", "compressedDepth"),
        live=False,
    )
    image_qos: str = setting(
        "auto",
        "reliability of the image subscriptions; auto = best effort, or reliable where images get lost and it is "
        "offered",
        choices=("auto", "reliable", "best_effort"),
        live=False,
    )
    publish_tf: bool = setting(False, "publish the pose as a transform too", live=False)
    rectified: str = setting(
        "auto",
        "kind of the images: rectified = P of their CameraInfo counts, raw = its K and D count, auto = by the topic's "
        "name",
        choices=RECTIFIED,
    )
    allow_resized: bool = setting(
        False, "accept images of another size than their CameraInfo, if both sides are scaled alike"
    )
    sync_slop: float = setting(
        0.02,
        "largest difference of stamps that belong together; equal stamps always pair",
        unit="s",
        low=0,
        high=10,
    )
    keyframe_overlap: float = setting(
        0.5, "smallest overlap with the keyframe; below it a new one is taken", low=0, high=1
    )
    keyframe_motion: float = setting(
        0.3, "largest distance from the keyframe; beyond it a new one is taken", unit="m", low=0, high=1000
    )
    keyframe_rotation: float = setting(
        20.0, "largest rotation from the keyframe; beyond it a new one is taken", unit="deg", low=0, high=180
    )
    keyframe_lost_after: int = setting(
        5,
        "number of frames in a row without a pose after which a new trajectory begins",
        unit="frames",
        low=1,
        high=1000,
    )
    source_frame: str = setting("", "frame name of the source camera; empty = frame_id of the source images")
    target_frame: str = setting("", "frame name of the target camera; empty = frame_id of the target images")
    lazy: bool = setting(
        True, "compute only while somebody subscribes to a result; with keyframe pairing the node always computes"
    )
    max_rate: float = setting(
        0.0, "largest number of pairs per second, 0 = as many as the machine manages", unit="Hz", low=0, high=1000
    )
    prior_max_age: float = setting(
        0.1,
        "largest difference of stamps between a prior and the source image; an older prior is not used, because its "
        "covariance does not cover the motion since; a prior with stamp zero is always used",
        unit="s",
        low=0,
        high=1e6,
    )
    input_timeout: float = setting(
        5.0, "longest silence of an input before diagnostics report an error", unit="s", low=0.1, high=3600
    )
    stage_timeout: float = setting(
        10.0, "longest computation before diagnostics report it as stuck", unit="s", low=0.1, high=3600
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source_frame and self.source_frame == self.target_frame:
            raise ConfigError(
                f"source_frame and target_frame are both {self.source_frame!r}: expected two names, because the pose "
                "is that of one in the other. Change one, or leave it empty for the frame_id of the images"
            )
