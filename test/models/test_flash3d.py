# SPDX-License-Identifier: Apache-2.0
"""Flash3D: parity with the published network on golden values, its input, its file, and the mixture it becomes."""

import copy
from dataclasses import replace

import golden_rule
import numpy as np
import pytest
import torch

from garps_core import Mixture
from garps_core.config.lifting import Lifting
from garps_core.errors import ConfigError, InputError, ModelError, ReconstructionError, WeightsError
from garps_core.mixtures.flash3d import (
    Flash3DGaussians,
    covariances_of,
    flash3d_input,
    gaussians_of,
    gaussians_to_mixture,
    padded_intrinsics,
    predict_gaussians,
    unprojected,
)
from garps_core.models.flash3d import Flash3D, GaussianMaps, flash3d_network, flash3d_tensors
from garps_core.models.resampling import lanczos, nearest_index
from garps_core.types import View

PREFIX = "models.unidepth_extended."
K = np.array([[345.5, 0, 190.0], [0, 350.0, 125.75], [0, 0, 1]])
"""The golden camera, counted from pixel centres as a View does."""
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    torch.exp(torch.zeros(1))  # the first call sets up the vector mathematics; see the notes of the golden values
    return {key: torch.from_numpy(value) for key, value in golden_rule.state("flash3d").items()}


@pytest.fixture(scope="module")
def network(state: dict[str, torch.Tensor]) -> Flash3D:
    return flash3d_network(flash3d_tensors(state)[0])


def golden_view() -> View:
    return View(golden_rule.image(256, 384), K, golden_rule.depth(256, 384))


@pytest.fixture(scope="module")
def run(network: Flash3D) -> tuple[Arrays, Flash3DGaussians]:
    """The maps of one prediction by their golden names, and its Gaussians."""
    maps: list[GaussianMaps] = []
    hook = network.register_forward_hook(lambda module, given, out: maps.append(out))
    gaussians = predict_gaussians(network, golden_view())
    hook.remove()
    return named_maps(maps[0], gaussians.K), gaussians


def named_maps(maps: GaussianMaps, camera: np.ndarray) -> Arrays:
    return {
        "out.depth": maps.depth.numpy(),
        "out.means": (unprojected(maps.depth, camera) + maps.offset).numpy(),
        "out.offset": maps.offset.numpy(),
        "out.opacity": maps.opacity.numpy(),
        "out.scaling": maps.sigmas.numpy(),
        "out.rotation": maps.rotation.numpy(),
        "out.features_dc": maps.harmonics.numpy(),
    }


def test_what_comes_out_is_what_was_published(run: tuple[Arrays, Flash3DGaussians]) -> None:
    assert len(golden_rule.compare("flash3d", run[0])) == 7


def test_every_tensor_of_the_published_network_is_met(network: Flash3D) -> None:
    """Compare in float64: the order of sums of 20 000 products in float32 moves some by more than the tolerance."""
    exact = copy.deepcopy(network).double()
    seen: Arrays = {}

    def keep(name: str):
        return lambda module, given, out: seen.update({name: out.numpy()})

    encoder = exact.encoder["encoder"]
    watched = {f"enc.layer{i}": encoder.get_submodule(f"layer{i}") for i in range(1, 5)}
    watched |= {"enc.f0": encoder.conv1, "enc.bn1": encoder.bn1}
    for part in ("depth", "gauss_decoder_0", "gauss_decoder_1"):
        watched |= {f"{part}.cb{i}": exact.models[part].decoder[i] for i in range(10)}
        watched[f"{part}.raw"] = exact.models[part]
    for name, module in watched.items():
        module.register_forward_hook(keep(name))
    given = flash3d_input(golden_view())
    picture = torch.from_numpy(given.picture).permute(2, 0, 1)[None].double() / 255
    maps = exact(picture, torch.from_numpy(given.depth)[None, None].double())
    seen |= {f"enc.f{i}": seen[f"enc.layer{i}"] for i in range(1, 5)}
    both = np.concatenate([seen[f"gauss_decoder_{layer}.raw"] for layer in (0, 1)])
    seen |= {**named_maps(maps, given.K), "out.features_rest": both[:, 14:]}
    assert len(golden_rule.compare("flash3d", seen)) == 51


def test_covariances_colours_and_the_order_of_the_list(run: tuple[Arrays, Flash3DGaussians]) -> None:
    seen, found = run
    columns = {"means": found.means, "cov": found.covariances, "rgb": found.colours, "opacity": found.opacities}
    with np.load(golden_rule.FOLDER / "flash3d_more.npz") as golden:
        rows, inner = golden["flat.index"], golden["flat.inner_index"]
    lists = {f"flat.{name}": part.reshape(len(part), -1)[rows] for name, part in columns.items()}
    as_maps = found.colours.reshape(2, 320, 448, 3).transpose(0, 3, 1, 2)
    covariances = covariances_of(*(torch.from_numpy(seen[f"out.{name}"]) for name in ("scaling", "rotation")))
    ratio = golden_rule.compare("flash3d_more", {"out.cov": covariances, "out.rgb": as_maps, **lists})
    assert len(ratio) == 6
    np.testing.assert_array_equal(found.index, np.arange(286_720))
    assert {0, 1} <= {float(found.colours.min()), float(found.colours.max())}
    _, row, column = np.unravel_index(found.index, (2, 320, 448))
    kept = found.index[(row >= 32) & (row < 288) & (column >= 32) & (column < 416)]
    assert len(kept) == 196_608
    np.testing.assert_array_equal(kept[::499], inner)


def test_without_its_border_the_list_is_the_inner_part(run: tuple[Arrays, Flash3DGaussians]) -> None:
    seen, whole = run
    maps = maps_again(seen)
    found = gaussians_of(maps, whole.K, np.ones((320, 448), bool), drop_border=True)
    with np.load(golden_rule.FOLDER / "flash3d_more.npz") as golden:
        np.testing.assert_array_equal(found.index[::499], golden["flat.inner_index"])
    np.testing.assert_array_equal(found.means, whole.means[found.index])
    np.testing.assert_array_equal(found.covariances, whole.covariances[found.index])


def maps_again(seen: Arrays) -> GaussianMaps:
    """The maps of the run, put together again."""
    names = ("depth", "offset", "opacity", "scaling", "rotation", "features_dc")
    return GaussianMaps(*(torch.as_tensor(seen[f"out.{name}"]) for name in names))


def test_the_step_to_the_second_layer_is_clamped(state: dict[str, torch.Tensor]) -> None:
    last = f"{PREFIX}models.depth.decoder.10.conv."
    network = flash3d_network(flash3d_tensors({k: v * 16 if k.startswith(last) else v for k, v in state.items()})[0])
    raw = []
    network.models["depth"].register_forward_hook(lambda module, given, out: raw.append(out.numpy()))
    found = predict_gaussians(network, golden_view())
    means = found.means.reshape(2, 320, 448, 3).transpose(0, 3, 1, 2)
    ours = {"clamp.depth.raw": raw[0], "clamp.out.depth": found.depth[:, None], "clamp.out.means": means}
    assert len(golden_rule.compare("flash3d_more", ours)) == 3
    assert (raw[0] > 6).mean() > 0.2 and (raw[0] < -10).mean() > 0.2
    np.testing.assert_allclose((found.depth[1] - found.depth[0]).max(), np.exp(6), rtol=1e-6)


def test_a_turned_gaussian_has_the_covariance_worked_out_by_hand() -> None:
    rotation = torch.tensor([0.8, 0.2, -0.4, 0.4]).reshape(1, 4, 1, 1)
    sigmas = torch.tensor([0.01, 0.02, 0.03]).reshape(1, 3, 1, 1)
    expected = [4.7632, 1.0176, -2.304, 1.0176, 5.3568, -3.072, -2.304, -3.072, 3.88]
    np.testing.assert_allclose(covariances_of(sigmas, rotation).ravel() * 1e4, expected, atol=1e-5)


def test_the_picture_is_resized_as_the_training_did_it() -> None:
    pillow = pytest.importorskip("PIL.Image")
    rng = np.random.default_rng(5)
    for height, width in ((240, 320), (360, 640), (721, 1283), (200, 900), (64, 48)):
        rgb = golden_rule.image(height, width)
        rgb[: height // 2] = rng.integers(0, 256, (height // 2, width, 3))
        theirs = np.asarray(pillow.fromarray(rgb).resize((384, 256), pillow.Resampling.LANCZOS))
        difference = np.abs(lanczos(rgb, 256, 384).astype(int) - theirs)
        assert difference.max() <= 1 and (difference > 0).mean() < 1e-3


def test_a_picture_of_the_right_size_stays_as_it_is() -> None:
    rgb = golden_rule.image(256, 384)
    np.testing.assert_array_equal(lanczos(rgb, 256, 384), rgb)
    given = flash3d_input(golden_view())
    np.testing.assert_array_equal(given.picture[32:-32, 32:-32], rgb)
    assert not given.picture[:32].any() and not given.picture[:, -32:].any()
    np.testing.assert_array_equal(given.depth, np.pad(golden_rule.depth(256, 384), 32, mode="edge"))
    expected = golden_rule.keys("flash3d")["inputs"]["K_padded"]
    np.testing.assert_allclose(given.K, expected, atol=1e-12)


def test_nearest_cells_are_those_of_torch() -> None:
    for size, wanted in ((480, 256), (1280, 384), (100, 256), (256, 256), (721, 384)):
        source = torch.arange(size, dtype=torch.float64)[None, None]
        expected = torch.nn.functional.interpolate(source, size=wanted, mode="nearest-exact")[0, 0]
        np.testing.assert_array_equal(nearest_index(size, wanted), expected)


def test_intrinsics_follow_a_point_through_the_resize() -> None:
    """A point at the corner of the picture lands on the corner of the picture inside its border."""
    camera = np.array([[500.0, 0, 310.2], [0, 480.0, 170.7], [0, 0, 1]])
    view = View(np.zeros((360, 640, 3), np.uint8), camera)
    for corner, expected in (((-0.5, -0.5), (32, 32)), ((639.5, 359.5), (32 + 384, 32 + 256))):
        ray = np.linalg.inv(camera) @ (*corner, 1)
        np.testing.assert_allclose((padded_intrinsics(view) @ ray)[:2], expected, atol=1e-9)


def test_gaps_in_the_depth_are_filled_and_left_out_of_the_mixture(run: tuple[Arrays, Flash3DGaussians]) -> None:
    seen, whole = run
    depth = golden_rule.depth(256, 384)
    depth[100:120, 50:90] = np.nan
    given = flash3d_input(View(golden_rule.image(256, 384), K, depth))
    assert np.isfinite(given.depth).all()
    assert not given.known[132:152, 82:122].any() and given.known.sum() == 320 * 448 - 20 * 40
    found = gaussians_of(maps_again(seen), whole.K, given.known)
    assert (found.opacities == 0).sum() == 2 * 20 * 40
    full, holed = (gaussians_to_mixture(g, golden_view(), along_curve=False) for g in (whole, found))
    gap = ~given.known.ravel()[whole.index % (320 * 448)]
    lost = gap & (whole.means[:, 2] >= 0.1) & (whole.means[:, 2] <= 20) & (whole.opacities >= 1 / 255)
    assert 1000 < lost.sum() == len(full) - len(holed)


def test_a_view_without_depth_is_refused(network: Flash3D) -> None:
    bare = View(golden_rule.image(256, 384), K)
    with pytest.raises(ReconstructionError, match="no depth"):
        predict_gaussians(network, bare)
    with pytest.raises(ReconstructionError, match="no reading"):
        predict_gaussians(network, replace(bare, depth=np.full((256, 384), np.nan, np.float32)))


def test_half_precision_stays_in_the_layers(network: Flash3D, run: tuple[Arrays, Flash3DGaussians]) -> None:
    """The first layer stands on the given depth to the last bit, and the second behind it."""
    found = predict_gaussians(network, golden_view(), dtype=torch.bfloat16)
    np.testing.assert_array_equal(found.depth[0], np.pad(golden_rule.depth(256, 384), 32, mode="edge"))
    assert found.means.dtype == np.float32 and (found.depth[1] > found.depth[0]).all()
    error = np.linalg.norm(found.means - run[1].means, axis=1)
    assert 1e-5 < np.median(error) < 0.03
    with pytest.raises(ConfigError, match="int8"):
        predict_gaussians(network, golden_view(), dtype=torch.int8)


def test_gaussians_that_are_no_numbers_are_refused(state: dict[str, torch.Tensor]) -> None:
    key = f"{PREFIX}models.gauss_decoder_0.out.weight"
    broken = flash3d_network(flash3d_tensors({**state, key: state[key] * 1e30})[0])
    with pytest.raises(ModelError, match="NaN or infinity"):
        predict_gaussians(broken, golden_view())


def mixture_of(run: tuple[Arrays, Flash3DGaussians], **settings) -> Mixture:
    return gaussians_to_mixture(run[1], golden_view(), **settings)


def test_the_mixture_stands_in_the_frame_of_the_view(run: tuple[Arrays, Flash3DGaussians]) -> None:
    """Without the learnt offsets the first layer is the given depth, seen through the view's own intrinsics."""
    seen, whole = run
    points = unprojected(torch.as_tensor(seen["out.depth"]), whole.K)[0].numpy()
    row, column = 71, 203
    ray = np.linalg.inv(K) @ (column, row, 1)
    np.testing.assert_allclose(
        points[:, row + 32, column + 32], ray * golden_rule.depth(256, 384)[row, column], rtol=1e-5
    )
    mixture = mixture_of(run)
    assert mixture.frustum is not None and mixture.frustum.depth.shape == (64, 96)
    assert mixture.frustum.brightness is not None
    # cell i of the coarse grid holds pixel 4 i + 2
    np.testing.assert_allclose(mixture.frustum.K @ np.linalg.inv(K) @ (4 * 9 + 2, 4 * 5 + 2, 1), (9, 5, 1), atol=1e-9)


def test_weights_are_opacity_times_area_or_opacity_alone(run: tuple[Arrays, Flash3DGaussians]) -> None:
    whole = run[1]
    plain = mixture_of(run, lifting=Lifting(weighting="equal"), along_curve=False)
    z = whole.means[:, 2]
    kept = (z >= 0.1) & (z <= 20) & (whole.opacities >= 1 / 255)
    assert 50_000 < kept.sum() == len(plain)
    np.testing.assert_array_equal(plain.weights, whole.opacities[kept])
    np.testing.assert_array_equal(plain.means, whole.means[kept])
    area = mixture_of(run, along_curve=False)
    np.testing.assert_allclose(area.weights, plain.weights * plain.means[:, 2] ** 2 / (345.5 * 350), rtol=1e-5)


def test_every_nth_component_is_spread_over_the_picture(run: tuple[Arrays, Flash3DGaussians]) -> None:
    curved, listed = mixture_of(run), mixture_of(run, along_curve=False)
    assert len(curved) == len(listed)
    np.testing.assert_allclose(np.sort(curved.weights), np.sort(listed.weights))
    first = curved.means[: len(curved) // 64]
    assert np.ptp(first[:, 0] / first[:, 2]) < 0.5 * np.ptp(listed.means[:, 0] / listed.means[:, 2])


def test_both_gaussians_of_a_pixel_share_its_label(run: tuple[Arrays, Flash3DGaussians]) -> None:
    view = golden_view()
    labels = (np.arange(256)[:, None] * 384 + np.arange(384)).astype(np.int32)
    mixture = gaussians_to_mixture(run[1], view, Lifting(max_range_m=1000), labels, along_curve=False)
    z = run[1].means[:, 2]
    index = run[1].index[(z >= 0.1) & (run[1].opacities >= 1 / 255)]
    _, row, column = np.unravel_index(index, (2, 320, 448))
    expected = labels[np.clip(row - 32, 0, 255), np.clip(column - 32, 0, 383)]
    np.testing.assert_array_equal(mixture.labels, expected)
    with pytest.raises(InputError, match="one per pixel"):
        gaussians_to_mixture(run[1], view, labels=labels[:10])


def test_flat_gaussians_become_definite(run: tuple[Arrays, Flash3DGaussians]) -> None:
    flat = np.outer([0.3, 0.4, 0.5], [0.3, 0.4, 0.5]).astype(np.float32)
    many = run[1]
    covariances = many.covariances.copy()
    covariances[::2], covariances[1::1001] = flat, 0
    mixture = gaussians_to_mixture(replace(many, covariances=covariances), golden_view())
    assert np.linalg.eigvalsh(mixture.covariances.astype(float)).min() > 0


def test_a_depth_in_the_wrong_unit_leaves_nothing(run: tuple[Arrays, Flash3DGaussians]) -> None:
    far = replace(run[1], means=run[1].means * np.float32(1000))
    with pytest.raises(ReconstructionError, match="unit of the depth"):
        gaussians_to_mixture(far, golden_view())


def test_only_our_part_of_a_published_file_is_read(state: dict[str, torch.Tensor]) -> None:
    other = {f"{PREFIX}unidepth.pixel_encoder.{i}": torch.zeros(1) for i in range(4)}
    other |= {f"backproject_depth.0.{name}": torch.zeros(1) for name in ("pix_coords", "id_coords", "ones")}
    moved = {f"module.{key}": value for key, value in {**state, **other}.items()}
    tensors, left = flash3d_tensors(moved)
    assert len(tensors) == 385
    assert left == {f"module.{PREFIX}unidepth": 4, f"module.{PREFIX}encoder": 2, "module": 3}


def test_a_file_that_was_cut_down_to_our_part_is_read_too(state: dict[str, torch.Tensor]) -> None:
    tensors, _ = flash3d_tensors(state)
    again, left = flash3d_tensors(tensors)
    assert again.keys() == tensors.keys() and left == {}


def test_counters_of_the_training_may_be_absent(state: dict[str, torch.Tensor]) -> None:
    short = {key: value for key, value in state.items() if not key.endswith("num_batches_tracked")}
    assert len(state) - len(short) == 53
    tensors, _ = flash3d_tensors(short)
    assert len(tensors) == 385
    flash3d_network(tensors)


def test_what_is_wrong_with_a_file_is_named(state: dict[str, torch.Tensor]) -> None:
    key = f"{PREFIX}models.gauss_decoder_1.out.weight"
    with pytest.raises(WeightsError, match=f"no {key}"):
        flash3d_tensors({k: v for k, v in state.items() if k != key})
    with pytest.raises(WeightsError, match=r"gauss_decoder_1.out.weight has shape \(14, 32, 1, 1\)"):
        flash3d_tensors({**state, key: torch.zeros(14, 32, 1, 1)})
    with pytest.raises(WeightsError, match="not finite"):
        flash3d_network(flash3d_tensors({**state, key: state[key] * torch.inf})[0])
    with pytest.raises(WeightsError, match=r"^2 keys end in"):
        flash3d_tensors({**state, **{f"ema.{name}": value for name, value in state.items()}})
    with pytest.raises(WeightsError, match=r"expected one\. Is this the file of Flash3D"):
        flash3d_tensors({"cls_token": torch.zeros(1)})
