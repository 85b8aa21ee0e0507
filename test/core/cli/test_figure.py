# SPDX-License-Identifier: Apache-2.0
"""The picture says what it should: green appears when the clouds coincide, and bad input is named."""

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("matplotlib")

from garps_core.cli.figure import BLUE, GREEN, YELLOW, before_after
from garps_core.errors import InputError
from garps_core.geometry import se3_exp, se3_inverse, transform
from garps_core.types import Mixture


def corner(n: int = 12000, seed: int = 0) -> Mixture:
    """A floor and two walls, 3 m deep, seen by a camera 1.2 m above the floor."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1, 1, (2, n))
    floor = np.stack([1.5 * a, np.full(n, 1.2), 2.5 + b], 1)
    back = np.stack([1.5 * a, 1.2 * b, np.full(n, 3.5)], 1)
    side = np.stack([np.full(n, -1.5), 1.2 * b, 2.5 + a], 1)
    means = np.concatenate([floor, back, side])
    return Mixture(means, np.tile(1e-4 * np.eye(3), (3 * n, 1, 1)), np.ones(3 * n), rng.uniform(0, 1, (3 * n, 3)))


def moved(mixture: Mixture, T: np.ndarray) -> Mixture:
    return Mixture(transform(T, mixture.means), mixture.covariances, mixture.weights, mixture.colours)


def pixels_of(image: np.ndarray, colour: np.ndarray) -> int:
    """Pixels with the hue of a colour, whatever their brightness."""
    bright = image.max(axis=2, keepdims=True).clip(1, 255)
    near = np.abs(image / bright - colour / colour.max()).max(axis=2) < 0.12
    return int((near & (bright[..., 0] > 60)).sum())


def test_green_grows_when_the_clouds_meet(tmp_path: Path) -> None:
    target = corner()
    truth = se3_exp(np.array([0.2, -0.05, 0.1, 0.02, 0.1, -0.03]))
    source = moved(corner(seed=1), se3_inverse(truth))
    start = se3_exp(np.array([0.15, 0.1, -0.1, 0.05, -0.1, 0.05])) @ truth
    path = before_after(source, target, start, truth, tmp_path / "pair.png", title="corner")
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(float)
    assert image.shape[0] > 600
    assert image.shape[1] > 900
    left, right = np.array_split(image[130:], 2, axis=1)
    assert pixels_of(right, GREEN) > 3 * pixels_of(left, GREEN)
    assert pixels_of(left, YELLOW) > 5000
    assert pixels_of(left, BLUE) > 5000


def test_what_cannot_be_drawn_is_said(tmp_path: Path) -> None:
    cloud, identity = corner(100), np.eye(4)
    empty = cloud.subset(np.zeros(len(cloud), bool))
    with pytest.raises(InputError, match="empty"):
        before_after(empty, cloud, identity, identity, tmp_path / "a.png")
    with pytest.raises(InputError, match="T_after"):
        before_after(cloud, cloud, identity, 2 * identity, tmp_path / "a.png")
    with pytest.raises(InputError, match="cannot write"):
        before_after(cloud, cloud, identity, identity, tmp_path / "no_such_folder" / "a.png")
    with pytest.raises(InputError, match="cannot write"):
        before_after(cloud, cloud, identity, identity, tmp_path / "a.xyz")


def test_a_tiny_and_a_far_mixture_are_drawn(tmp_path: Path) -> None:
    few = corner(20)
    T = np.eye(4)
    T[:3, 3] = 40, 0, 0
    assert before_after(few, few, T, np.eye(4), tmp_path / "few.png").stat().st_size > 5000
