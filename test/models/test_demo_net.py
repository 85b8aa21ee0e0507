# SPDX-License-Identifier: Apache-2.0
"""The depth network in the package: small, safe to load, better than guessing on rooms it has not seen, asked for by
name only, and called a demonstration wherever it appears."""

import json
import logging
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from places import ROOT

from garps_core import Config, View, estimate_relative_pose, metrics
from garps_core.cli import command
from garps_core.cli.doctor import examine
from garps_core.config import PRESETS, depth_networks
from garps_core.errors import ConfigError, InputError, ModelError, WeightsError
from garps_core.mixtures.reconstruct import with_depth
from garps_core.models import demo_net
from garps_core.models.demo_net import DemoNet, demo_input, depth_of_views, shipped
from garps_core.models.depth_networks import preset_for
from garps_core.models.in_use import Networks
from garps_core.weights.reader import read_tensors

pytestmark = pytest.mark.usefixtures("one_thread")
FILE = ROOT / "garps_core" / "models" / demo_net.FILE
DEMONSTRATION = "a demonstration: it knows generated rooms only"


@pytest.fixture(scope="module")
def network() -> DemoNet:
    return shipped()


@pytest.fixture(scope="module")
def rooms():
    pytest.importorskip("embreex")
    from bench.rooms import make_pair

    return [make_pair(seed, level=1 + seed % 4) for seed in (70_001, 70_002, 70_003)]


def views_of(pair) -> tuple[View, View]:
    return View(pair.rgb0, pair.K0), View(pair.rgb1, pair.K1)


def test_it_is_small() -> None:
    tensors = read_tensors(FILE).tensors
    assert FILE.stat().st_size < 6_000_000
    assert sum(value.numel() for value in tensors.values()) <= 1_500_000
    assert {value.dtype for value in tensors.values()} == {torch.float16}


def test_the_package_with_it_stays_small(tmp_path: Path) -> None:
    """The three packages, compressed as in a wheel."""
    with zipfile.ZipFile(tmp_path / "all.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for package in ("garps_core", "garps_ros", "msg_adapters"):
            for path in (ROOT / package).rglob("*"):
                if path.suffix in (".py", ".safetensors"):
                    archive.write(path, path.relative_to(ROOT))
    assert (tmp_path / "all.zip").stat().st_size < 10_000_000


def test_the_file_says_how_it_was_made() -> None:
    told = read_tensors(FILE).metadata
    assert told["licence"] == "Apache-2.0" and DEMONSTRATION.split(":")[0] in told["what"]
    assert int(told["steps"]) > 0 and int(told["rooms"]) > 0 and 0 < float(told["AbsRel"]) < 0.3


def test_it_knows_rooms_it_has_not_seen_better_than_a_guess(network: DemoNet, rooms) -> None:
    errors, guessed = [], []
    for pair in rooms:
        for found, true in zip(
            depth_of_views(network, views_of(pair)), (pair.true_depth0, pair.true_depth1), strict=True
        ):
            assert found.shape == true.shape and found.dtype == np.float32
            errors.append(float(np.nanmean(np.abs(found - true) / true)))
            guessed.append(float(np.nanmean(np.abs(np.nanmedian(true) - true) / true)))  # even told the median
    assert np.mean(errors) < 0.2 and np.mean(errors) < 0.8 * np.mean(guessed)


def test_pairs_and_single_views_agree(network: DemoNet, rooms) -> None:
    source, target = views_of(rooms[0])
    together, alone = depth_of_views(network, [source, target]), depth_of_views(network, [source])
    np.testing.assert_allclose(together[0], alone[0], rtol=1e-5)
    assert not np.allclose(together[0], together[1], rtol=0.01)


def test_other_pixels_for_the_same_camera_give_the_same_depth(network: DemoNet, rooms) -> None:
    """Half the resolution, with the intrinsics of that."""
    source, _ = views_of(rooms[1])
    rgb = cv2.resize(source.rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    K = source.K.copy()
    K[:2, :2] /= 2
    K[:2, 2] = (source.K[:2, 2] + 0.5) / 2 - 0.5
    whole, half = (depth_of_views(network, [view])[0] for view in (source, View(rgb, K)))
    ratio = cv2.resize(whole, half.shape[::-1], interpolation=cv2.INTER_AREA) / half
    assert np.median(ratio) == pytest.approx(1, abs=0.02) and np.percentile(np.abs(ratio - 1), 90) < 0.05


def test_rays_lie_where_the_intrinsics_say() -> None:
    K = np.array([[400.0, 0, 319.5], [0, 410.0, 239.5], [0, 0, 1]])
    found, focal = demo_input(np.zeros((480, 640, 3), np.uint8), K)
    assert found.shape == (5, 192, 256) and found.dtype == np.float32
    assert found[3].mean() == pytest.approx(0, abs=1e-6) and found[4].mean() == pytest.approx(0, abs=1e-6)
    assert found[3, 0, -1] == pytest.approx((639 - 0.75 - 319.5) / 400, abs=1e-6)  # its centre is 2.5 px wide
    assert focal == pytest.approx(np.sqrt(400 * 410) * 0.4 / demo_net.UNIT_FOCAL_PX)


@pytest.mark.parametrize("shape", [(100, 301), (301, 100)])
def test_elongated_pictures_are_refused(network: DemoNet, shape: tuple[int, int]) -> None:
    K = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
    with pytest.raises(InputError, match=f"rgb is {shape[1]}x{shape[0]}: expected sides within a factor of 3"):
        depth_of_views(network, [View(np.zeros((*shape, 3), np.uint8), K)])


def test_depth_that_is_not_finite_is_an_error(rooms) -> None:
    broken = shipped()
    with torch.no_grad():
        broken.answer.bias.fill_(float("nan"))
    with pytest.raises(ModelError, match="not finite"):
        depth_of_views(broken, views_of(rooms[0]))


def test_a_file_that_is_not_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / demo_net.FILE).write_bytes(FILE.read_bytes()[:1000])
    monkeypatch.setattr(demo_net, "files", lambda package: tmp_path)
    with pytest.raises(WeightsError):
        shipped()
    (tmp_path / demo_net.FILE).unlink()
    with pytest.raises(WeightsError, match="cannot read"):
        shipped()


def test_nothing_takes_it_but_who_asks_for_it(rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))  # nothing is installed
    assert "demo_net" in depth_networks()
    naming = [name for name in PRESETS if Config.preset(name).reconstruction.method == "demo_net"]
    assert naming == ["demo_net"]
    for preset in ("monocular", "paper"):
        with pytest.raises(WeightsError, match="no depth with the image, and none from a network"):
            with_depth(views_of(rooms[0]), Config.preset(preset))
    assert preset_for("demo_net", True) == preset_for("demo_net", False) == "demo_net"
    assert (preset_for("auto", True), preset_for("auto", False)) == ("default", "monocular")


def test_a_sensors_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"reconstruction\.method is demo_net, whose depth is off by per cents"):
        with_depth(
            [View(np.zeros((64, 64, 3), np.uint8), np.diag([50.0, 50.0, 1]))],
            Config().replace({"reconstruction.method": "demo_net"}),
        )


def test_it_is_called_a_demonstration(
    rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))  # loaded anew
    with caplog.at_level(logging.WARNING, "garps_core"):
        assert isinstance(Networks().depth_network(Config.preset("demo_net")), DemoNet)
    assert f"demo_net is {DEMONSTRATION}" in caplog.text
    rows, _ = examine()
    assert DEMONSTRATION in dict(rows)["demo_net"]
    estimate = estimate_relative_pose(*views_of(rooms[0]), Config.preset("demo_net"))
    assert DEMONSTRATION in estimate.depth_from


def test_two_plain_images_give_a_pose_on_the_command_line(
    rooms, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from bench.demo.rgb import written

    pair = rooms[0]
    words = written(pair, tmp_path)
    assert command.main([*words, "--json", "--ply", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    T = np.array(found["T_target_source"])
    assert DEMONSTRATION in found["depth_from"]
    assert metrics.rotation_error_deg(T, pair.T_1_0) < 3
    assert metrics.translation_error_m(T, pair.T_1_0) < 0.15
    assert metrics.nees(T, np.array(found["covariance"]), pair.T_1_0) < 3 * metrics.CHI2_6_95
    asked = [word.replace("--preset", "--reconstruction") for word in words]  # brings its preset with it
    assert command.main(asked) == 0
    assert f"depth        by demo_net, {DEMONSTRATION}" in capsys.readouterr().out
    assert (tmp_path / "source.ply").is_file() or list(tmp_path.glob("*.ply"))


def test_depth_that_comes_with_the_view_is_left_alone_only_without_it(rooms) -> None:
    """Asked for by name, the network stands above the sensor, as the other one does."""
    pair = rooms[2]
    with_sensor = [
        replace(view, depth=depth)
        for view, depth in zip(views_of(pair), (pair.true_depth0, pair.true_depth1), strict=True)
    ]
    found = with_depth(with_sensor, Config.preset("demo_net"))
    assert not np.allclose(found[0].depth, pair.true_depth0, rtol=1e-3, equal_nan=True)
    scaled = with_depth(with_sensor, Config.preset("demo_net").replace({"reconstruction.depth_scale": 2.0}))
    np.testing.assert_allclose(scaled[0].depth, 2 * found[0].depth, rtol=1e-5)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_gives_the_same_depth(rooms) -> None:
    views = views_of(rooms[0])
    here = depth_of_views(shipped(), views)
    there = depth_of_views(shipped().to("cuda"), views)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3)
