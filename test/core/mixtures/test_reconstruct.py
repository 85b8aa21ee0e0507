# SPDX-License-Identifier: Apache-2.0
"""Where the depth of a view comes from: a sensor, or a network that is installed; and what is said where it cannot."""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import golden_rule
import numpy as np
import pytest
import torch
from box_room import K
from network_weights import DEPTH, install, pair, passes, shared, tensors

from garps_core import Config, Status, View, estimate_relative_pose
from garps_core.cli import command
from garps_core.devices import on_device
from garps_core.errors import ConfigError, InputError, ModelError, ReconstructionError, WeightsError
from garps_core.mixtures import reconstruct as reconstruction
from garps_core.models import depth_anything
from garps_core.models.depth_anything import HEADS, TRAINING_FX, depth_of_images
from garps_core.weights.manifest import BY_NAME

MONOCULAR = Config.preset("monocular")
LAST_BIAS = "depth_head.scratch.output_conv2.2.bias"
"""Of the number that becomes depth: 0 is half the range."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("weights"), DEPTH)


@pytest.fixture(autouse=True)
def installed(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network is there, and looks at small pictures."""
    monkeypatch.setenv("GARPS_WEIGHTS", str(weights))
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 70)


def asked(preset: Config = MONOCULAR, **changes: object) -> Config:
    return preset.replace({f"reconstruction.{name}": value for name, value in changes.items()})


def network() -> depth_anything.DepthAnythingV2:
    return shared().depth_network(MONOCULAR)


def with_depth(views: Sequence[View], config: Config) -> list[View]:
    return reconstruction.with_depth(views, config, shared())


@pytest.mark.parametrize("preset", ["sensor", "monocular"])
def test_with_a_sensor_no_network_is_imported(preset: str, tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np; from garps_core import Config, View, estimate_relative_pose as estimate\n"
        "rgb = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)\n"
        "view = View(rgb, np.array([[80, 0, 40], [0, 80, 30], [0, 0, 1.0]]), np.full((60, 80), 2, np.float32))\n"
        f"print(estimate(view, view, Config.preset({preset!r})).T_target_source is not None)\n"
        "print(sorted(name for name in sys.modules if name.startswith('garps_core.models.') or name == 'safetensors'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.stdout.split("\n")[:2] == [
        "True",
        "['garps_core.models.depth_networks', 'garps_core.models.in_use']",
    ], done.stderr


def test_both_views_share_one_pass_of_the_installed_network() -> None:
    views = pair()
    with passes(depth_anything.DepthAnythingV2) as seen:
        found = with_depth(views, MONOCULAR)
    assert seen == [(2, 3, 70, 98)]
    expected = depth_of_images(network(), [view.rgb for view in views])
    for view, given, depth in zip(found, views, expected, strict=True):
        np.testing.assert_array_equal(view.depth, depth)
        assert given.depth is None and view.rgb is given.rgb


def test_auto_asks_the_network_only_for_what_is_missing() -> None:
    bare, seen_by_sensor = pair()[0], pair(depth=True)[1]
    with passes(depth_anything.DepthAnythingV2) as seen:
        first, second = with_depth([bare, seen_by_sensor], MONOCULAR)
    assert seen == [(1, 3, 70, 98)]
    assert first.depth is not None and second is seen_by_sensor


@pytest.mark.parametrize("method", ["auto", "rgbd", "flash3d", "depth_anything_v2"])
def test_only_the_network_that_is_named_replaces_a_sensor(method: str) -> None:
    views = pair(depth=True)
    found = with_depth(views, asked(method=method))
    if method == "depth_anything_v2":
        (expected,) = depth_of_images(network(), [views[0].rgb])
        np.testing.assert_allclose(found[0].depth, expected, atol=2e-3)
        assert np.abs(found[0].depth - views[0].depth).mean() > 1
    else:
        assert [a is b for a, b in zip(found, views, strict=True)] == [True, True]


def test_a_pose_comes_with_the_time_of_the_network() -> None:
    assert estimate_relative_pose(*pair(), MONOCULAR).seconds["depth"] > 0
    assert "depth" not in estimate_relative_pose(*pair(depth=True), MONOCULAR).seconds


def test_nothing_installed_says_what_to_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    for changes, wanted in (
        ({}, "garps weights fetch depth-anything-v2-indoor-small"),
        ({"scene": "outdoor"}, "garps weights fetch depth-anything-v2-outdoor-small"),
        ({"depth_weights": "depth-anything-v2-indoor-base"}, "garps weights fetch depth-anything-v2-indoor-base"),
    ):
        for method in ("auto", "depth_anything_v2", "flash3d"):
            with pytest.raises(WeightsError, match=f"`{wanted}`"):
                estimate_relative_pose(*pair(), asked(method=method, **changes))
    with pytest.raises(WeightsError, match=r"no depth with the image.*or give depth"):
        with_depth(pair(), MONOCULAR)
    with pytest.raises(WeightsError, match="`garps weights fetch flash3d`"):
        estimate_relative_pose(*pair(depth=True), asked(method="flash3d"))
    with pytest.raises(WeightsError, match=r"ade20k_linear.*download it from https://\S+_ade20k_linear_head\.pth"):
        estimate_relative_pose(*pair(depth=True), asked(Config(), semantics="linear"))


def test_another_folder_is_another_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = network()
    assert network() is here
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    with pytest.raises(WeightsError, match="no depth_anything weights"):
        network()


def test_weights_for_another_scene_are_refused(weights: Path) -> None:
    with pytest.raises(WeightsError, match="`garps weights fetch depth-anything-v2-outdoor-small`"):
        with_depth(pair(), asked(scene="outdoor"))
    for given in (DEPTH, str(weights / BY_NAME[DEPTH].local)):
        with pytest.raises(WeightsError, match=r"reconstruction\.scene is outdoor: expected indoor for depth_any"):
            with_depth(pair(), asked(scene="outdoor", depth_weights=given))
    with_depth(pair(), asked(scene="indoor"))


def test_a_larger_file_under_a_small_name_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As large as the Base model, which has another licence; a hole, since no byte of it is read."""
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    with (tmp_path / BY_NAME[DEPTH].local).open("wb") as file:
        file.truncate(390_000_000)
    with pytest.raises(WeightsError, match=r"vits\.pth has 390000000 bytes: expected at most 110000000"):
        with_depth(pair(), MONOCULAR)


def test_the_size_of_a_network_is_that_of_its_tensors(tmp_path: Path, weights: Path) -> None:
    """Whatever its name says: here Small under the name of Base."""
    path = tmp_path / BY_NAME["depth-anything-v2-indoor-base"].local
    path.symlink_to(weights / BY_NAME[DEPTH].local)
    assert shared().depth_network(asked(depth_weights=str(path))).head == HEADS["vits"]


def test_a_relative_model_is_refused_by_its_name(tmp_path: Path, weights: Path) -> None:
    path = tmp_path / "depth_anything_v2_vits.pth"
    path.symlink_to(weights / BY_NAME[DEPTH].local)
    for scene in ("any", "indoor"):
        with pytest.raises(WeightsError, match="name of a relative model: expected a metric one"):
            with_depth(pair(), asked(depth_weights=str(path), scene=scene))


@pytest.mark.parametrize("corrected", [False, True], ids=["plain", "focal correction"])
def test_a_relative_model_is_refused_by_what_it_says(tmp_path: Path, corrected: bool) -> None:
    """Its large numbers become the end of the range nearly everywhere, at any focal length."""
    torch.save(tensors(DEPTH) | {LAST_BIAS: torch.full((1,), 50.0)}, tmp_path / "other.pth")
    config = asked(depth_weights=str(tmp_path / "other.pth"), scene="indoor", focal_correction=corrected)
    wide = [replace(view, K=K * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]]) for view in pair()]
    with pytest.raises(ReconstructionError, match=r"100% of the network's depth .* all it can say.*no relative model"):
        with_depth(wide, config)


def test_a_sensors_settings_and_a_networks_depth_do_not_go_together() -> None:
    with pytest.raises(ReconstructionError, match=r"no depth.*preset monocular"):
        estimate_relative_pose(*pair(), Config())
    for method in ("depth_anything_v2", "flash3d"):
        with pytest.raises(ConfigError, match=rf"reconstruction\.method is {method}.*preset monocular"):
            estimate_relative_pose(*pair(), asked(Config(), method=method))
    with pytest.raises(ReconstructionError, match="no depth"):
        estimate_relative_pose(*pair(), asked(method="rgbd"))
    with pytest.raises(ConfigError, match=r"garps align a\.ply b\.ply"):
        estimate_relative_pose(*pair(depth=True), asked(method="ply"))
    assert with_depth(pair(), asked(Config.preset("paper"), method="depth_anything_v2"))[0].depth is not None


class Memory:
    """Memory of a device for a number of pictures; a call with more fails as it does on the device."""

    def __init__(self, pictures: int) -> None:
        self.pictures = pictures

    def __enter__(self) -> list[int]:
        seen: list[int] = []

        def check(_module: object, given: tuple[torch.Tensor]) -> None:
            seen.append(len(given[0]))
            if len(given[0]) > self.pictures:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

        self.hook = network().register_forward_pre_hook(check)
        return seen

    def __exit__(self, *_: object) -> None:
        self.hook.remove()


def test_where_two_pictures_do_not_fit_one_by_one_do() -> None:
    with Memory(1) as seen:
        found = with_depth(pair(), MONOCULAR)
    assert seen == [2, 1, 1]
    for one, other in zip(found, with_depth(pair(), MONOCULAR), strict=True):
        np.testing.assert_allclose(one.depth, other.depth, atol=2e-3)


def test_where_none_fits_there_is_no_mixture() -> None:
    with Memory(0) as seen:
        estimate = estimate_relative_pose(*pair(), MONOCULAR)
    assert seen == [2, 1]
    assert (estimate.status, estimate.T_target_source, estimate.ok) == (Status.NO_MIXTURE, None, False)
    assert "out of memory on cpu with one image of 98x70" in estimate.reason


def test_weights_that_do_not_fit_a_device_are_no_crash() -> None:
    class Full(torch.nn.Module):
        def to(self, *_: object) -> "Full":
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    with pytest.raises(ModelError, match="out of memory on cpu for the weights of Full"):
        on_device(Full(), "cpu")


def test_values_that_are_no_numbers_are_no_mixture_and_damaged_weights_an_error(tmp_path: Path) -> None:
    norm = "pretrained.norm.bias"
    for value in (3e38, float("nan")):
        torch.save(tensors(DEPTH) | {norm: torch.full((384,), value)}, tmp_path / f"{value}.pth")
    estimate = estimate_relative_pose(*pair(), asked(depth_weights=str(tmp_path / "3e+38.pth"), scene="indoor"))
    assert estimate.status is Status.NO_MIXTURE
    assert "NaN or infinity in torch.float32" in estimate.reason
    with pytest.raises(WeightsError, match=r"norm\.bias has 384 of 384 values that are not finite"):
        estimate_relative_pose(*pair(), asked(depth_weights=str(tmp_path / "nan.pth"), scene="indoor"))


def test_the_smallest_view_has_depth_and_a_strip_is_refused() -> None:
    small = View(golden_rule.image(16, 16), np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]))
    (found,) = with_depth([small], MONOCULAR)
    assert found.depth is not None and found.depth.shape == (16, 16) and np.isfinite(found.depth).all()
    with pytest.raises(ReconstructionError, match=r"usable depth pixels of 256"):
        reconstruction.reconstruct(small, MONOCULAR.replace({"lifting.stride": 4}))
    for size in ((16, 2000), (2000, 16)):
        strip = View(np.zeros((*size, 3), np.uint8), K)
        with pytest.raises(InputError, match=rf"{size[1]}x{size[0]} pixels.*Crop the image"):
            estimate_relative_pose(strip, strip, MONOCULAR)


def test_scale_and_focal_length_change_the_depth() -> None:
    plain, scaled, corrected = (
        with_depth(pair(), asked(**changes))[0].depth
        for changes in ({}, {"depth_scale": 1.25}, {"focal_correction": True})
    )
    np.testing.assert_allclose(scaled, 1.25 * plain, rtol=1e-6)
    np.testing.assert_allclose(corrected, 150 / 160 / TRAINING_FX * plain, rtol=1e-6)
    with pytest.raises(ReconstructionError, match=r"the network's depth has median .* m"):
        with_depth(pair(), asked(depth_scale=1000.0))


def test_half_precision_changes_the_depth_a_little() -> None:
    plain, half = (with_depth(pair(), asked(network_dtype=dtype))[0].depth for dtype in ("float32", "bfloat16"))
    assert 0 < np.median(np.abs(half / plain - 1)) < 0.02


@pytest.mark.parametrize("layout", ["official", "model", "state_dict", "safetensors", "misnamed"])
def test_every_layout_of_a_file_gives_the_same_depth(layout: str, weights: Path, tmp_path: Path) -> None:
    path = tmp_path / ("mine.safetensors" if layout == "misnamed" else "mine.pth")
    if layout == "safetensors":
        path = path.with_suffix(".safetensors")
        source = str(weights / BY_NAME[DEPTH].local)
        assert command.main(["weights", "convert", source, str(path), "--variant", "indoor"]) == 0
    else:
        wrapped = layout in ("model", "state_dict")
        torch.save({layout: tensors(DEPTH), "epoch": 3} if wrapped else tensors(DEPTH), path)
        with pytest.raises(WeightsError, match=r"reconstruction\.scene is missing: expected indoor or outdoor"):
            with_depth(pair(), asked(depth_weights=str(path)))
    scene = "any" if layout == "safetensors" else "indoor"
    (found, _), (expected, _) = (
        with_depth(pair(), asked(**changes)) for changes in ({"depth_weights": str(path), "scene": scene}, {})
    )
    np.testing.assert_array_equal(found.depth, expected.depth)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("depth-anything-v2-indor-small", "did you mean 'depth-anything-v2-indoor-small'"),
        ("flash3d", "flash3d are weights of flash3d: expected some of depth_anything"),
        ("nothing.pth", "cannot read nothing.pth"),
        ("weights.bin", "no weights are named 'weights.bin'"),
    ],
)
def test_weights_that_are_not_there_are_named(given: str, message: str) -> None:
    with pytest.raises(WeightsError, match=message):
        with_depth(pair(), asked(depth_weights=given))
