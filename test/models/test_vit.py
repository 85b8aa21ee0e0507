# SPDX-License-Identifier: Apache-2.0
"""The vision transformer computes what the published one does, whatever its size, under the names of its files."""

import numpy as np
import pytest
import torch
from golden_rule import IMAGENET, chw, compare, image, keys, state

from garps_core.errors import InputError, WeightsError
from garps_core.models.vit import GRID, PATCH, SIZES, SwiGlu, VisionTransformer, VitSize, size_of

NAME = "dinov2_vits14_ade20k"
TINY = VitSize(width=48, blocks=3, heads=2, gated=True)


def tensors(name=NAME, file="backbone"):
    return {key: torch.from_numpy(value) for key, value in state(name, file).items()}


@pytest.fixture(scope="module")
def vit():
    torch.exp(torch.zeros(1))  # the first large one of a process may be wrong
    network = VisionTransformer(SIZES["vits"]).eval()
    network.load_state_dict(tensors(), strict=True)
    return network


def padded():
    """image(200, 300) with zeros around, as 210x308."""
    return torch.from_numpy(np.pad(chw(image(200, 300), *IMAGENET), ((0, 0), (0, 0), (5, 5), (4, 4))))


def test_golden_tokens_blocks_and_maps(vit):
    ours = {"input_padded": padded()}
    hooks = [vit.blocks[0].register_forward_pre_hook(lambda _, given: ours.update(tokens=given[0]))]
    for i, block in enumerate(vit.blocks):
        hooks.append(block.register_forward_hook(lambda _m, _g, out, name=f"block{i}": ours.update({name: out})))
    with torch.inference_mode():
        maps = vit(ours["input_padded"], (8, 9, 10, 11))
    for hook in hooks:
        hook.remove()
    ours |= {f"tap{i}": found for i, found in zip((8, 9, 10, 11), maps, strict=True)}
    ratio = compare(NAME, ours)
    assert len(ratio) == 18
    print(f"largest error / tolerance: {max(ratio.values()):.2f}")


def test_taps_come_in_the_order_asked_and_do_not_depend_on_each_other(vit):
    x = padded()[..., :56, :70]
    with torch.inference_mode():
        first, last = vit(x, (7, 2))
        (alone,) = vit(x, (2,))
    assert first.shape == last.shape == (1, 384, 4, 5)
    assert torch.equal(last, alone)
    assert not torch.allclose(first, last)


def test_a_batch_is_its_images_one_by_one(vit):
    x = torch.from_numpy(np.concatenate([chw(image(56, 84, y0=y), *IMAGENET) for y in (0, 40)]))
    with torch.inference_mode():
        (both,) = vit(x, (11,))
        single = torch.cat([vit(x[i : i + 1], (11,))[0] for i in range(2)])
    torch.testing.assert_close(both, single, rtol=0, atol=2e-5)
    assert (both[0] - both[1]).abs().max() > 0.1


def test_learned_positions_are_used_as_they_are_on_the_learned_grid(vit):
    assert vit.positions((GRID, GRID)) is vit.pos_embed
    assert vit.positions((GRID, GRID + 1)).shape == (1, 1 + GRID * (GRID + 1), 384)


@pytest.mark.parametrize("shape", [(13, 14), (14, 15), (518, 500), (0, 14)])
def test_sides_that_are_no_multiples_of_a_patch_are_refused(vit, shape):
    with pytest.raises(InputError, match=f"{shape[0]}x{shape[1]}.*multiples of 14"):
        vit(torch.zeros(1, 3, *shape), (0,))


def test_gated_network_has_the_published_shapes():
    """The giant has 4096 hidden channels, so w12 has 8192 rows."""
    with torch.device("meta"):
        giant = VisionTransformer(SIZES["vitg"])
    held = giant.state_dict()
    assert held["blocks.39.mlp.w12.weight"].shape == (8192, 1536)
    assert held["blocks.39.mlp.w3.weight"].shape == (1536, 4096)
    assert not any("fc1" in key for key in held)
    assert sum(p.numel() for p in giant.parameters()) == 1_136_480_768
    assert size_of(held) == "vitg"


def test_a_small_gated_transformer_runs_and_gates():
    torch.manual_seed(0)
    network = VisionTransformer(TINY).eval()
    with torch.inference_mode():
        (found,) = network(torch.randn(2, 3, 3 * PATCH, 2 * PATCH), (2,))
        gated = SwiGlu(48)
        x = torch.randn(1, 5, 48)
        a, b = (x @ gated.w12.weight.T + gated.w12.bias).split(gated.w3.in_features, dim=-1)
        expected = (a * torch.sigmoid(a) * b) @ gated.w3.weight.T + gated.w3.bias
        torch.testing.assert_close(gated(x), expected)
    assert found.shape == (2, 48, 3, 2)
    assert found.isfinite().all()


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("prefix", ["", "pretrained."])
def test_size_is_told_from_shapes(name, prefix):
    with torch.device("meta"):
        held = VisionTransformer(SIZES[name]).state_dict()
    assert size_of({prefix + key: value for key, value in held.items()}, prefix) == name


def test_unknown_sizes_are_refused():
    with torch.device("meta"):
        held = VisionTransformer(TINY).state_dict()
    with pytest.raises(WeightsError, match=r"width 48 with 3 blocks.*vits 384 x 12"):
        size_of(held)
    with pytest.raises(WeightsError, match="no cls_token among 1 tensors"):
        size_of({"decode_head.conv_seg.weight": torch.zeros(1)})
    with pytest.raises(WeightsError, match="none"):
        size_of({})


def test_names_are_those_of_the_published_files(vit):
    listed = {key: tuple(shape) for key, shape, *_ in keys(NAME)["files"]["backbone"]}
    assert {key: tuple(value.shape) for key, value in vit.state_dict().items()} == listed
