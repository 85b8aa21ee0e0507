# SPDX-License-Identifier: Apache-2.0
"""Depth Anything V2 computes what the published one does, from files of either layout, and refuses what cannot be."""

import cv2
import numpy as np
import pytest
import torch
from golden_rule import IMAGENET, chw, compare, image, keys, state

from garps_core.errors import ConfigError, InputError, ModelError, WeightsError
from garps_core.models import depth_anything
from garps_core.models.depth_anything import HEADS, DepthAnythingV2, built_from, depth_of_images, from_transformers
from garps_core.models.vit import SIZES, VisionTransformer
from garps_core.models.vit import from_transformers as backbone_from_transformers

NAME, HF = "dav2_vits_metric", "dav2_vits_metric_hf"
SMALL = (60, 80)
"""Size of pictures where the test does not depend on it; the network's side is made small, too."""


@pytest.fixture(scope="module")
def tensors():
    """Tensors of the official file."""
    return {key: torch.from_numpy(value) for key, value in state(NAME).items()}


@pytest.fixture(scope="module")
def model(tensors):
    torch.exp(torch.zeros(1))  # the first large one of a process may be wrong
    return built_from(tensors, max_depth=20.0)


@pytest.fixture
def small_side(monkeypatch):
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 70)


def hf_tensors(tensors, new=False):
    """Parameters in the `transformers` layout, `new` with the attention's newer names."""
    held = {}
    for key, _, official, *rows in keys(HF)["files"]["model"]:
        if new:
            key = key.replace("attention.output.dense", "attention.o_proj")
            for part in ("query", "key", "value"):
                key = key.replace(f"attention.attention.{part}", f"attention.{part[0]}_proj")
        held[key] = tensors[official][slice(*rows[0])] if rows else tensors[official]
    return held


def golden_modules(model):
    """Name in the golden file -> module whose output it is."""
    head = model.depth_head
    scratch = head.scratch
    named = {f"block{i}": block for i, block in enumerate(model.pretrained.blocks)}
    for i in range(4):
        named |= {f"project{i}": head.projects[i], f"resize{i}": head.resize_layers[i]}
        named |= {f"{part}{i + 1}{end}": getattr(scratch, f"{part}{i + 1}{end}") for part, end in FUSED}
    return named | {"output_conv1": scratch.output_conv1, "logit": scratch.output_conv2}


FUSED = (("layer", "_rn"), ("refinenet", ""))


def recorded(model, x, prefix):
    """Every golden tensor of one pass."""
    ours = {}
    modules = golden_modules(model)

    def record(name):
        return lambda _module, _given, out: ours.update({f"{prefix}.{name}": out})

    def record_taps(_module, _given, maps):
        ours.update({f"{prefix}.tap{i}": found for i, found in enumerate(maps)})

    hooks = [module.register_forward_hook(record(name)) for name, module in modules.items()]
    hooks.append(model.pretrained.register_forward_hook(record_taps))
    first = model.pretrained.blocks[0]
    hooks.append(first.register_forward_pre_hook(lambda _, given: ours.update({f"{prefix}.tokens": given[0]})))
    with torch.inference_mode():
        ours[f"{prefix}.out.depth"] = model(x)
    for hook in hooks:
        hook.remove()
    return ours


def picture(h, w):
    return torch.from_numpy(chw(image(h, w), *IMAGENET))


def test_golden_values_of_every_part(model):
    ratio = compare(NAME, recorded(model, picture(252, 336), "252x336"))
    assert len(ratio) == 36
    print({name: round(value, 2) for name, value in ratio.items()})


def test_golden_values_on_the_learned_grid(model):
    ours = recorded(model, picture(518, 518), "518x518")
    selected = ("tokens", "block0", "block11", "refinenet4", "refinenet1", "logit", "out.depth")
    assert len(compare(NAME, {f"518x518.{name}": ours[f"518x518.{name}"] for name in selected})) == 7


def test_golden_values_from_a_picture_to_its_depth(model):
    rgb = image(240, 320)
    size = depth_anything.network_size(rgb)
    (depth,) = depth_of_images(model, [rgb])
    ours = {"infer240x320.tensor": depth_anything.resized_input(rgb, size)[None], "infer240x320.out.depth": depth}
    assert len(compare(NAME, ours)) == 2
    assert depth.dtype == np.float32


@pytest.mark.parametrize("new", [False, True], ids=["saved names", "names of the modules"])
def test_files_of_the_transformers_library_give_the_same_parameters(tensors, new):
    official = from_transformers(hf_tensors(tensors, new))
    assert set(official) == set(tensors)
    assert all(torch.equal(official[key], tensors[key]) for key in tensors)


def test_a_network_from_a_transformers_file_is_the_same(model, tensors):
    twin = built_from(hf_tensors(tensors), max_depth=20.0)
    x = picture(56, 70)
    with torch.inference_mode():
        assert torch.equal(twin(x), model(x))


def test_a_gated_backbone_has_other_names_too():
    named = {"encoder.layer.3.mlp.weights_in.bias": 1, "encoder.layer.3.mlp.weights_out.weight": 2}
    assert backbone_from_transformers(named) == {"blocks.3.mlp.w12.bias": 1, "blocks.3.mlp.w3.weight": 2}


@pytest.mark.parametrize(("name", "parameters"), [("vits", 24.785e6), ("vitb", 97.5e6), ("vitl", 335.3e6)])
def test_published_numbers_of_parameters(name, parameters):
    with torch.device("meta"):
        network = DepthAnythingV2(name, 20.0)
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(parameters, rel=1e-3)


def test_the_size_is_told_from_shapes():
    with torch.device("meta"):
        held = DepthAnythingV2("vitb", 20.0).state_dict()
    built = built_from({key: torch.zeros(()).expand(value.shape) for key, value in held.items()}, 80.0)
    assert built.head == HEADS["vitb"]
    assert built.max_depth == 80.0
    assert not built.training


def test_weights_that_do_not_fit_are_refused(tensors):
    less = {key: value for key, value in tensors.items() if key != "depth_head.projects.2.bias"}
    with pytest.raises(WeightsError, match=r"Depth Anything V2 vits.*1 of 239.*missing.*projects\.2\.bias"):
        built_from(less, 20.0)
    with pytest.raises(WeightsError, match=r"1 are unexpected.*depth_head\.more"):
        built_from(tensors | {"depth_head.more": torch.zeros(1)}, 20.0)
    with pytest.raises(WeightsError, match=r"another shape.*pos_embed: 1x257x384.*expected 1x1370x384"):
        built_from(tensors | {"pretrained.pos_embed": torch.zeros(1, 257, 384)}, 20.0)
    with pytest.raises(WeightsError, match=r"pretrained\.norm\.bias has 384 of 384 values that are not finite"):
        built_from(tensors | {"pretrained.norm.bias": torch.full((384,), float("nan"))}, 20.0)
    with pytest.raises(WeightsError, match=r"no pretrained\.cls_token"):
        built_from({"decode_head.conv_seg.weight": torch.zeros(1)}, 20.0)
    with torch.device("meta"):
        giant = VisionTransformer(SIZES["vitg"]).state_dict()
    with pytest.raises(WeightsError, match="vitg: expected one of vits, vitb, vitl"):
        built_from({f"pretrained.{key}": value for key, value in giant.items()}, 20.0)


def test_a_transformers_file_that_is_another_or_not_whole_is_refused(tensors):
    held = hf_tensors(tensors)
    with pytest.raises(WeightsError, match=r"head\.conv4\.bias is no name"):
        from_transformers(held | {"head.conv4.bias": torch.zeros(1)})
    for part in ("query", "value"):
        key = f"backbone.encoder.layer.5.attention.attention.{part}.bias"
        with pytest.raises(WeightsError, match=rf"no blocks\.5\.attn\.{part[0]}\.bias to make"):
            from_transformers({name: value for name, value in held.items() if name != key})


@pytest.mark.parametrize("max_depth", [0.0, -20.0, float("nan")])
def test_a_largest_depth_that_cannot_be_is_refused(tensors, max_depth):
    with pytest.raises(ConfigError, match=r"max_depth.*indoor.*20"):
        built_from(tensors, max_depth)


def test_depth_ends_at_the_largest(model, tensors):
    far = built_from(tensors, max_depth=80.0)
    x = picture(56, 70)
    with torch.inference_mode():
        near, outdoor = model(x), far(x)
    torch.testing.assert_close(outdoor, 4 * near)
    assert 0 <= near.min() < near.max() <= 20


SIZED = {(360, 640): (518, 924), (720, 1280): (518, 924), (480, 640): (518, 686), (256, 384): (518, 784)}


@pytest.mark.parametrize(("size", "expected"), [*SIZED.items(), ((640, 480), (686, 518)), ((14, 14), (518, 518))])
def test_network_size(size, expected):
    assert depth_anything.network_size(np.zeros((*size, 3), np.uint8)) == expected


@pytest.mark.parametrize("size", [(480, 640), (1200, 900)], ids=["enlarged", "shrunk"])
def test_the_picture_is_resized_before_it_is_rounded(size):
    """Against OpenCV on normalised numbers, which commutes with the resize; overshoot is kept."""
    rgb = np.where(image(*size) > 127, 255, 0).astype(np.uint8)
    target = depth_anything.network_size(rgb)
    ours = depth_anything.resized_input(rgb, target).numpy()
    normalised = (rgb / 255.0 - IMAGENET[0]) / IMAGENET[1]
    theirs = cv2.resize(normalised, target[::-1], interpolation=cv2.INTER_CUBIC).transpose(2, 0, 1)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert ours.max() > ((1 - np.array(IMAGENET[0])) / IMAGENET[1]).max() + 0.05


def test_two_pictures_of_one_size_share_a_pass_and_others_do_not(model, small_side, monkeypatch):
    """Neither changes the result, and the order stays."""
    rgb = [image(*SMALL), image(*SMALL[::-1]), image(*SMALL, x0=40)]
    passes = []
    hook = model.register_forward_pre_hook(lambda _, given: passes.append(tuple(given[0].shape)))
    together = depth_of_images(model, rgb)
    hook.remove()
    assert passes == [(2, 3, 70, 98), (1, 3, 98, 70)]
    alone = [depth_of_images(model, [one])[0] for one in rgb]
    for one, other, given in zip(together, alone, rgb, strict=True):
        assert one.shape == given.shape[:2]
        np.testing.assert_allclose(one, other, atol=2e-3)
    assert np.abs(together[0] - together[2]).max() > 0.1
    assert depth_of_images(model, []) == []


def test_scale_and_focal_length_multiply_depth(model, small_side):
    rgb = [image(*SMALL)]
    (plain,) = depth_of_images(model, rgb)
    (scaled,) = depth_of_images(model, rgb, depth_scale=1.25)
    (corrected,) = depth_of_images(model, rgb, fx=[80 * 0.5])
    np.testing.assert_allclose(scaled, 1.25 * plain, rtol=1e-6)
    np.testing.assert_allclose(corrected, np.tan(np.radians(30)) * plain, rtol=1e-6)
    same, half = depth_of_images(model, rgb * 2, fx=[40 / np.tan(np.radians(30)), 20 / np.tan(np.radians(30))])
    np.testing.assert_allclose(same, plain, atol=2e-3)
    np.testing.assert_allclose(half, 0.5 * plain, atol=2e-3)


@pytest.mark.parametrize(
    ("dtype", "bound"), [(torch.bfloat16, 0.01), (torch.float16, 0.002)], ids=["bfloat16", "float16"]
)
def test_what_half_precision_costs(model, monkeypatch, dtype, bound):
    """An upper bound of order: with pseudo-random weights depth varies over a pixel as it never will."""
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 140)
    rgb = [image(120, 160)]
    (full,), (half,) = depth_of_images(model, rgb), depth_of_images(model, rgb, dtype=dtype)
    error = np.abs(half / full - 1)
    print(f"{dtype}: median {np.median(error):.2%}, 99 % {np.quantile(error, 0.99):.2%}, max {error.max():.2%}")
    assert half.dtype == np.float32
    assert 0 < np.median(error) < bound


BAD_IMAGES = {
    "float": (np.zeros((60, 80, 3), np.float32), "float32.*HxWx3 uint8"),
    "grey": (np.zeros((60, 80), np.uint8), r"uint8 \(60, 80\).*HxWx3"),
    "with alpha": (np.zeros((60, 80, 4), np.uint8), "HxWx3"),
    "no array": ([[1]], "list.*HxWx3"),
    "empty": (np.zeros((0, 80, 3), np.uint8), "80x0 pixels: expected at least 14x14"),
    "smaller than a patch": (np.zeros((13, 80, 3), np.uint8), "80x13 pixels: expected at least 14x14"),
    "a line": (np.zeros((14, 4000, 3), np.uint8), "4000x14 .*147994x518.*4144.*Crop"),
    "a column": (np.zeros((4000, 400, 3), np.uint8), "400x4000 .*518x5180.*Crop"),
}


@pytest.mark.parametrize(("given", "message"), BAD_IMAGES.values(), ids=BAD_IMAGES)
def test_pictures_that_cannot_be_are_refused(model, given, message):
    with pytest.raises(InputError, match=message):
        depth_of_images(model, [image(*SMALL), given])


@pytest.mark.parametrize("fx", [[100.0], [100.0, 0.0], [100.0, float("nan")], [-1.0, 100.0]])
def test_focal_lengths_that_cannot_be_are_refused(model, fx):
    with pytest.raises(InputError, match="for 2 images: expected one positive"):
        depth_of_images(model, [image(*SMALL)] * 2, fx=fx)


def test_settings_that_cannot_be_are_refused(model):
    for scale in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match="depth_scale"):
            depth_of_images(model, [image(*SMALL)], depth_scale=scale)
    with pytest.raises(ConfigError, match="device is 'gpu'"):
        depth_of_images(model, [image(*SMALL)], device="gpu")
    with pytest.raises(ConfigError, match=r"torch\.int8.*float16"):
        depth_of_images(model, [image(*SMALL)], dtype=torch.int8)


def out_of_memory_above(limit):
    """A hook that fails as a device does when a batch is larger."""

    def check(_module, given):
        if len(given[0]) > limit:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    return check


def test_where_two_do_not_fit_in_memory_one_by_one_do(model, small_side):
    rgb = [image(*SMALL), image(*SMALL, x0=40)]
    hook = model.register_forward_pre_hook(out_of_memory_above(1))
    try:
        found = depth_of_images(model, rgb)
    finally:
        hook.remove()
    for one, other in zip(found, depth_of_images(model, rgb), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-3)


def test_where_not_even_one_fits_in_memory_the_error_says_so(model, small_side):
    hook = model.register_forward_pre_hook(out_of_memory_above(0))
    try:
        with pytest.raises(ModelError, match="out of memory on cpu with one image of 98x70"):
            depth_of_images(model, [image(*SMALL)])
    finally:
        hook.remove()


def test_depth_that_is_no_number_is_an_error(tensors, small_side):
    damaged = built_from(tensors | {"pretrained.norm.bias": torch.full((384,), 3e38)}, 20.0)
    with pytest.raises(ModelError, match=r"NaN or infinity in torch\.float32"):
        depth_of_images(damaged, [image(*SMALL)])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_gives_the_same_depth(tensors, small_side):
    rgb = [image(*SMALL)]
    (here,) = depth_of_images(built_from(tensors, 20.0), rgb)
    (there,) = depth_of_images(built_from(tensors, 20.0), rgb, device="cuda")
    np.testing.assert_allclose(there, here, rtol=0.02)
