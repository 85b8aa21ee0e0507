# SPDX-License-Identifier: Apache-2.0
"""The live node's own settings: what is subscribed, paired and published. The estimator's are `garps_core.Config`."""

from __future__ import annotations

from dataclasses import dataclass

from garps_core.config import PRESETS
from garps_core.config.field import Checked, setting
from garps_core.errors import ConfigError


@dataclass(frozen=True)
class NodeSettings(Checked, prefix=""):
    """Settings of `pose_node`; those that are not live are fixed when the node starts. Raises ConfigError."""

    preset: str = setting(
        "default",
        "the estimator's settings to start from",
        choices=tuple(PRESETS),
        live=False,
    )
    pairing: str = setting(
        "cameras",
        "cameras = two cameras, images of the same time; keyframe = the source camera alone, against its keyframe",
        choices=("cameras", "keyframe"),
        live=False,
    )
    image_transport: str = setting(
        "raw", "of the images; compressed = topic + /compressed", choices=("raw", "compressed"), live=False
    )
    depth_transport: str = setting(
        "raw",
        "of the depth; otherwise topic + / + this",
        choices=("raw", "compressed", "compressedDepth"),
        live=False,
    )
    image_qos: str = setting(
        "auto",
        "reliability of the image subscriptions; auto = best effort, reliable where images get lost and it is offered",
        choices=("auto", "reliable", "best_effort"),
        live=False,
    )
    publish_tf: bool = setting(False, "also publish the pose as a transform", live=False)
    rectified: str = setting(
        "auto",
        "are the images rectified? auto = by topic name; true = use P; false = use K and D",
        choices=("auto", "true", "false"),
    )
    allow_resized: bool = setting(False, "accept images whose size is that of their CameraInfo, scaled evenly")
    sync_slop: float = setting(
        0.02, "largest difference of stamps that belong together; equal stamps always pair", unit="s", low=0, high=10
    )
    keyframe_overlap: float = setting(0.5, "new keyframe when the overlap falls below", low=0, high=1)
    keyframe_motion: float = setting(0.3, "new keyframe beyond this distance", unit="m", low=0, high=1000)
    keyframe_rotation: float = setting(20.0, "new keyframe beyond this rotation", unit="deg", low=0, high=180)
    keyframe_lost_after: int = setting(
        5, "a new trajectory begins after so many frames in a row without a pose", unit="frames", low=1, high=1000
    )
    source_frame: str = setting("", "name to publish instead of the frame_id of the source images")
    target_frame: str = setting("", "name to publish instead of the frame_id of the target images")
    lazy: bool = setting(True, "compute only while somebody subscribes to a result; keyframe pairing always computes")
    max_rate: float = setting(
        0.0, "most pairs per second, 0 = as fast as the machine allows", unit="Hz", low=0, high=1000
    )
    prior_max_age: float = setting(
        0.1,
        "a prior whose stamp differs more from the source image's is not used, for its covariance is taken as it is, "
        "however far the camera has moved since; one with zero stamp always is used",
        unit="s",
        low=0,
        high=1e6,
    )
    input_timeout: float = setting(
        5.0, "an input silent for longer is reported as an error", unit="s", low=0.1, high=3600
    )
    stage_timeout: float = setting(
        10.0, "a computation that takes longer is reported as stuck", unit="s", low=0.1, high=3600
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source_frame and self.source_frame == self.target_frame:
            raise ConfigError(
                f"source_frame and target_frame are both {self.source_frame!r}: expected two names, for the pose is of "
                "the one in the other; change one, or leave it empty for the frame_id of the images"
            )
