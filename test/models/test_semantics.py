# SPDX-License-Identifier: Apache-2.0
"""Semantic labels: parity with the published heads on golden values, the merging of passes, labels on mixtures."""

import golden_rule
import numpy as np
import pytest
import torch
from random_splats import random_mixture
from torch.nn import functional as F

from garps_core import Config
from garps_core.errors import ConfigError, InputError, ModelError, WeightsError
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.models.semantics import BAND_ROWS, Segmenter, labelled, padded_input, scores_of, segment, segmenter_of
from garps_core.types import View

NAME = "dinov2_vits14_ade20k"
Tensors = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def files() -> dict[str, Tensors]:
    torch.exp(torch.zeros(1))
    return {
        file: {key: torch.from_numpy(value) for key, value in golden_rule.state(NAME, file).items()}
        for file in ("backbone", "linear", "ms")
    }


@pytest.fixture(scope="module")
def networks(files: dict[str, Tensors]) -> dict[str, Segmenter]:
    return {head: segmenter_of(files["backbone"], files[head]) for head in ("linear", "ms")}


def low(network: Segmenter, rgb: np.ndarray) -> torch.Tensor:
    with torch.inference_mode():
        return network(padded_input(rgb))


def margin(full: torch.Tensor) -> np.ndarray:
    best = full.topk(2, dim=0).values
    return (best[0] - best[1])[None].numpy()


@pytest.mark.parametrize("head", ["linear", "ms"])
def test_the_published_heads_are_met(networks: dict[str, Segmenter], head: str) -> None:
    network, rgb = networks[head], golden_rule.image(200, 300)
    full = scores_of(network, rgb, official=True).pixels(0, 200)
    ours = {
        "input_padded": padded_input(rgb),
        f"{head}.out.low": low(network, rgb),
        f"{head}.out.full": full[None],
        f"{head}.out.labels": segment(network, rgb, official=True)[None],
        f"{head}.out.margin": margin(full),
    }
    golden_rule.compare(NAME, ours)


@pytest.mark.parametrize("head", ["linear", "ms"])
def test_odd_sizes_are_padded_and_cut_as_meant(networks: dict[str, Segmenter], head: str) -> None:
    network, rgb = networks[head], golden_rule.image(201, 299)
    cropped = scores_of(network, rgb).pixels(0, 201)
    ours = {
        "input_padded": padded_input(rgb),
        f"{head}.out.low": low(network, rgb),
        f"{head}.official.full": scores_of(network, rgb, official=True).pixels(0, 201)[None],
        f"{head}.crop.full": cropped[None],
        f"{head}.crop.labels": segment(network, rgb)[None],
        f"{head}.crop.margin": margin(cropped),
    }
    golden_rule.compare(f"{NAME}_more", {f"201x299.{name}": value for name, value in ours.items()})


def test_the_taps_are_the_last_four_blocks(networks: dict[str, Segmenter]) -> None:
    network = networks["ms"]
    with torch.inference_mode():
        maps = network.backbone(padded_input(golden_rule.image(200, 300)), network.taps)
    golden_rule.compare(NAME, {f"tap{block}": value for block, value in zip((8, 9, 10, 11), maps, strict=True)})


def plainly_merged(network: Segmenter, rgb: np.ndarray, sizes: list[tuple[int, int]], flips: list[bool]) -> np.ndarray:
    """Compute the labels step by step, with whole pictures of all classes."""
    import cv2

    total = torch.zeros(150, *rgb.shape[:2])
    for height, width in sizes:
        for flip in flips:
            picture = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR)
            scores = low(network, np.ascontiguousarray(picture[:, ::-1]) if flip else picture)
            padded = [14 * n for n in scores.shape[-2:]]
            top, left = ((p - s) // 2 for p, s in zip(padded, (height, width), strict=True))
            full = F.interpolate(scores, size=padded, mode="bilinear", align_corners=False)
            full = full[:, :, top : top + height, left : left + width]
            full = F.interpolate(full, size=rgb.shape[:2], mode="bilinear", align_corners=False)
            probability = full.softmax(dim=1)[0]
            total += probability.flip(-1) if flip else probability
    return total.numpy()


def test_passes_are_merged_by_their_probabilities(networks: dict[str, Segmenter]) -> None:
    network, rgb = networks["linear"], golden_rule.image(100, 151)
    assert rgb.shape[0] > BAND_ROWS, "the picture must be made of several bands"
    found = segment(network, rgb, ratios=(1.0, 1.32), flip=True)
    total = plainly_merged(network, rgb, [(100, 151), (132, 199)], [False, True])
    clear = np.diff(np.sort(total, axis=0)[-2:], axis=0)[0] > 1e-4
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(found[clear], total.argmax(axis=0)[clear])
    single = segment(network, rgb)
    assert (single != found).mean() > 0.05, "merging must matter here"


def test_a_smaller_picture_gives_labels_of_the_whole(networks: dict[str, Segmenter]) -> None:
    network, rgb = networks["linear"], golden_rule.image(150, 225)
    found = segment(network, rgb, short_side=98)
    expected = plainly_merged(network, rgb, [(98, 147)], [False])
    assert found.shape == (150, 225) and found.dtype == np.int16
    assert (found == expected.argmax(axis=0)).mean() > 0.99


def test_the_mirrored_pass_comes_back_unmirrored(networks: dict[str, Segmenter]) -> None:
    network = networks["linear"]
    rgb = golden_rule.image(98, 140)
    turned = np.ascontiguousarray(rgb[:, ::-1])
    there = scores_of(network, rgb, mirrored=True).pixels(0, 98)
    back = scores_of(network, turned).pixels(0, 98).flip(-1)
    torch.testing.assert_close(there, back, atol=1e-5, rtol=0)


def test_the_head_is_told_by_its_width(files: dict[str, Tensors], networks: dict[str, Segmenter]) -> None:
    assert networks["linear"].taps == (11,) and networks["ms"].taps == (8, 9, 10, 11)
    weight = "decode_head.conv_seg.weight"
    with pytest.raises(WeightsError, match="768 channels"):
        segmenter_of(files["backbone"], {**files["linear"], weight: torch.zeros(150, 768, 1, 1)})
    with pytest.raises(WeightsError, match="no decode_head"):
        segmenter_of(files["backbone"], files["backbone"])
    with pytest.raises(WeightsError, match="cls_token"):
        segmenter_of(files["linear"], files["linear"])
    with pytest.raises(WeightsError, match=r"missing, the first bn\.running_var"):
        segmenter_of(files["backbone"], {k: v for k, v in files["ms"].items() if k != "decode_head.bn.running_var"})


def test_the_backbone_may_have_the_names_of_transformers(
    files: dict[str, Tensors], networks: dict[str, Segmenter]
) -> None:
    named: Tensors = {"classifier.weight": torch.zeros(1000, 768), "classifier.bias": torch.zeros(1000)}
    (listed,) = golden_rule.keys("dav2_vits_metric_hf")["files"].values()
    for key, _, official, *rows in listed:
        if key.startswith("backbone."):
            value = files["backbone"][official.removeprefix("pretrained.")]
            named["dinov2." + key.removeprefix("backbone.")] = value[slice(*rows[0])] if rows else value
    found = segmenter_of(named, files["linear"]).state_dict()
    assert all(torch.equal(value, found[key]) for key, value in networks["linear"].state_dict().items())


def test_what_cannot_be_segmented_is_said(networks: dict[str, Segmenter], files: dict[str, Tensors]) -> None:
    network, rgb = networks["linear"], golden_rule.image(40, 40)
    with pytest.raises(InputError, match="float64"):
        segment(network, rgb / 255.0)
    with pytest.raises(ConfigError, match="ratios"):
        segment(network, rgb, ratios=())
    with pytest.raises(ConfigError, match="short_side 5"):
        segment(network, rgb, short_side=5)
    with pytest.raises(ConfigError, match="int8"):
        segment(network, rgb, dtype=torch.int8)
    weight = "decode_head.conv_seg.weight"
    broken = segmenter_of(files["backbone"], {**files["linear"], weight: torch.full((150, 384, 1, 1), 3e38)})
    with pytest.raises(ModelError, match="NaN or infinity"):
        segment(broken, rgb)


def test_lifted_components_take_the_label_of_their_pixel() -> None:
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    rng = np.random.default_rng(0)
    depth = (2 + 0.004 * np.arange(160) * np.ones((120, 1))).astype(np.float32)
    rgb = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    mixture = reconstruct(View(rgb, K, depth), Config())
    labels = rgb[:, :, 0].astype(np.int16)
    found = labelled(mixture, labels, K)
    np.testing.assert_array_equal(found.labels, np.rint(mixture.colours[:, 0] * 255))
    assert found.frustum is mixture.frustum


def test_labels_of_another_form_are_refused() -> None:
    mixture = random_mixture(20)
    with pytest.raises(InputError, match="behind the camera"):
        labelled(mixture, np.zeros((4, 4), int), np.eye(3))
    with pytest.raises(InputError, match="HxW integers"):
        labelled(mixture, np.zeros((4, 4)), np.eye(3))
