# SPDX-License-Identifier: Apache-2.0
"""COLMAP's incremental mapping of two images, with a length from depth: features, matches and model are its own.

Both kinds keep the given intrinsics fixed and accept two-view tracks, without which COLMAP 4 never makes a model of two
images. One thread and fixed seeds: two calls give the same model.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from bench.peers.features_pnp import Failure
from bench.peers.metres import Triangulated, with_length
from garps_core.checks import Float64Array
from garps_core.types import View

NAMES = ("source.png", "target.png")
SEED, THREADS = 0, 1
RELAXED = {
    "init_min_tri_angle": 0.5,
    "init_min_num_inliers": 15,
    "abs_pose_min_num_inliers": 10,
    "filter_min_tri_angle": 0.1,
}
"""Settings of the mapper for baselines that are short against the depth.

The defaults are 16 deg, 100, 30 and 1.5 deg.
"""
CENTRE = 0.5
"""COLMAP's pixel coordinates of the centre of the first pixel."""


def colmap(source: View, target: View) -> Float64Array:
    """Incremental mapping of COLMAP with its defaults; the length of t from depth (`bench.peers.metres`)."""
    return _mapped(source, target, {})


def colmap_relaxed(source: View, target: View) -> Float64Array:
    """Incremental mapping of COLMAP for short baselines (`RELAXED`); the length of t from depth."""
    return _mapped(source, target, RELAXED)


def _mapped(source: View, target: View, mapper: Mapping[str, float]) -> Float64Array:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # a failure is an answer here
    pycolmap.set_random_seed(SEED)
    with TemporaryDirectory() as name:
        folder = Path(name)
        database = folder / "database.db"
        for view, image in zip((source, target), NAMES, strict=True):
            cv2.imwrite(str(folder / image), view.rgb[..., ::-1])
            _extract(pycolmap, database, folder, image, view)
        count = _match(pycolmap, database)
        options = pycolmap.IncrementalPipelineOptions(_pipeline(mapper))
        models = pycolmap.incremental_mapping(database, folder, folder, options)
    whole = [model for model in models.values() if model.num_reg_images() == len(NAMES)]
    if not whole:
        raise Failure(f"COLMAP made no model of both images ({count} verified matches)")
    return _pose(whole[0], source, target)


def _extract(pycolmap: Any, database: Path, folder: Path, image: str, view: View) -> None:
    """SIFT of one image into the database, with its camera."""
    K = view.K
    params = (K[0, 0], K[1, 1], K[0, 2] + CENTRE, K[1, 2] + CENTRE)
    camera = {"camera_model": "PINHOLE", "camera_params": ",".join(repr(float(value)) for value in params)}
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = THREADS, False
    reader, one_camera = pycolmap.ImageReaderOptions(camera), pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(database, folder, [image], one_camera, reader, options, pycolmap.Device.cpu)


def _match(pycolmap: Any, database: Path) -> int:
    """Matches into the database: how many are verified."""
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.num_threads, options.use_gpu = THREADS, False
    verification.ransac.random_seed = SEED
    pycolmap.match_exhaustive(
        database, matching_options=options, verification_options=verification, device=pycolmap.Device.cpu
    )
    with pycolmap.Database.open(database) as held:
        return int(held.num_inlier_matches())


def _pipeline(mapper: Mapping[str, float]) -> dict[str, Any]:
    """Settings of the mapping that differ from the defaults."""
    own = {"num_threads": THREADS, "random_seed": SEED}
    fixed = {"abs_pose_refine_focal_length": False, "abs_pose_refine_extra_params": False}
    return {
        **own,
        "min_model_size": len(NAMES),
        "extract_colors": False,
        "ba_refine_focal_length": False,
        "ba_refine_extra_params": False,
        "triangulation": {"ignore_two_view_tracks": False, "random_seed": SEED},
        "mapper": {**own, **fixed, **mapper},
    }


def _pose(model: Any, source: View, target: View) -> Float64Array:
    """4x4 T_target_source of a model, in metres."""
    images = {image.name: image for image in model.images.values()}
    poses, seen = [], []
    for view, name in zip((source, target), NAMES, strict=True):
        observed = [point for point in images[name].points2D if point.has_point3D()]
        points = np.reshape([model.points3D[point.point3D_id].xyz for point in observed], (-1, 3))
        pixels = np.reshape([point.xy for point in observed], (-1, 2)) - CENTRE
        poses.append(np.vstack([images[name].cam_from_world().matrix(), [0, 0, 0, 1]]))
        seen.append(Triangulated(view, pixels, points @ poses[-1][2, :3] + poses[-1][2, 3]))
    return with_length(poses[1] @ np.linalg.inv(poses[0]), seen)
