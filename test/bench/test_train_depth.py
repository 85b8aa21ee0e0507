# SPDX-License-Identifier: Apache-2.0
"""Rooms to learn depth from are what they say, and a training that was stopped goes on as if it had not been."""

import numpy as np
import pytest
import torch

from bench.rooms.shading import camera_rays
from bench.train_depth import Training, folded, loss_of, rate_at
from bench.training.pictures import batches
from bench.training.rooms import shots
from garps_core import View
from garps_core.models.demo_net import HEIGHT, WIDTH, DemoNet, depth_of_views

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 4


class Few:
    """Three pictures of one room, as `bench.training.pictures.Pictures` holds those of many."""

    def __init__(self):
        from bench.training.pictures import Pictures

        found = list(shots(100_007, 3))
        self.rgb = np.stack([shot.rgb for shot in found])
        self.depth = np.stack([np.rint(1000 * shot.depth).astype(np.uint16) for shot in found])
        self.K = np.stack([shot.K for shot in found])
        self.drawn, self.whole = (getattr(Pictures, name).__get__(self) for name in ("drawn", "whole"))

    def __len__(self):
        return 3


@pytest.fixture(scope="module")
def few():
    return Few()


def trained(few, begin, until, training=None):
    training = training or Training.begun(0)
    for seen, wanted in batches(few, begin, until, seed=0):
        training.network.train()
        training.take(seen[:2], wanted[:2], STEPS)
    return training


def test_a_seed_is_a_room(few):
    again = next(shots(100_007, 1))
    assert np.array_equal(again.rgb, few.rgb[0]) and pytest.approx(few.K[0]) == again.K
    assert few.rgb.shape == (3, HEIGHT, WIDTH, 3) and few.depth[few.depth > 0].min() / 1000 > 0.2
    assert np.median(few.depth) > 1000 and few.depth.max() < 12_000


def test_what_a_crop_shows_lies_where_its_intrinsics_say(few):
    """Cropped, stretched and mirrored, a picture's points keep their distances to the camera."""
    rng = np.random.default_rng(1)
    whole, drawn = few.whole(0), few.drawn(0, rng)
    for sample in (whole, drawn):
        depth = np.exp(sample.wanted) * sample.focal
        slopes = sample.seen[3:, ::2, ::2]
        points = depth[..., None] * np.stack([*slopes, np.ones_like(depth)], axis=-1)
        reach = np.linalg.norm(points, axis=-1)
        assert np.nanmin(reach) > 0.2
    rays = camera_rays(few.K[0], WIDTH, HEIGHT)
    true = np.linalg.norm(rays * (few.depth[0] / 1000)[..., None], axis=-1)
    assert np.nanpercentile(reach, [5, 95]) == pytest.approx(np.nanpercentile(true, [5, 95]), rel=0.25)


def test_the_loss_is_of_shape_and_scale():
    wanted = torch.rand(2, 16, 20)
    assert loss_of(wanted, wanted) == 0
    assert loss_of(wanted + 0.1, wanted) == pytest.approx(0.1, rel=1e-5), "a scale has no slopes"
    hole = wanted.clone()
    hole[:, :8] = float("nan")
    assert loss_of(wanted + 0.1, hole) == pytest.approx(0.1, rel=1e-5)


def test_the_rate_rises_and_falls():
    rates = [rate_at(step, 5000) for step in range(5000)]
    assert rates[0] < rates[150] < max(rates) == rates[300] and rates[-1] < 1e-6


def test_a_training_that_was_stopped_goes_on_as_if_it_had_not_been(few, tmp_path):
    through = trained(few, 0, STEPS)
    stopped = trained(few, 0, 2)
    stopped.save(tmp_path / "checkpoint.pt")
    resumed = Training.begun(1)
    resumed.resume(tmp_path / "checkpoint.pt")
    assert resumed.step == 2
    trained(few, 2, STEPS, resumed)
    for name, value in through.averaged.state_dict().items():
        assert torch.equal(value, resumed.averaged.state_dict()[name]), name


def test_without_batch_norms_it_is_the_same_function(few):
    network = trained(few, 0, 2).averaged.eval()
    picture = torch.from_numpy(few.whole(0).seen)[None]
    with torch.inference_mode():
        assert torch.allclose(folded(network)(picture), network(picture), atol=1e-4)


def test_it_fits_into_the_package_and_knows_the_focal_length(few):
    network = DemoNet().eval()
    assert sum(value.numel() for value in network.parameters()) < 1.5e6
    K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    rgb = np.zeros((240, 320, 3), np.uint8)
    with torch.no_grad():
        network.answer.weight.zero_()
    near, far = depth_of_views(network, [View(rgb, K), View(rgb, K * [[2, 2, 1], [2, 2, 1], [1, 1, 1]])])
    assert near.shape == (240, 320) and near.dtype == np.float32
    assert far == pytest.approx(2 * near)
