# SPDX-License-Identifier: Apache-2.0
"""Mask2Former on ViT-Adapter, reduced and random: its parts against plain formulas, its sizes, and every parameter."""

from __future__ import annotations

import math

import golden_rule
import numpy as np
import pytest
import torch
from small_mask2former import ADAPTER, HEAD, random_state
from torch.nn import functional as F

from garps_core.errors import InputError, WeightsError
from garps_core.models.deformable import (
    POINTS,
    DeformableAttention,
    as_maps,
    as_tokens,
    centres,
    sine_positions,
)
from garps_core.models.mask2former import HeadSize, Mask2Former, mask2former_of, segment_by_masks
from garps_core.models.vit_adapter import AdapterSize

GRIDS = [(7, 9), (4, 5), (2, 3)]


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    return random_state(Mask2Former(ADAPTER, HEAD))


@pytest.fixture(scope="module")
def network(state: dict[str, torch.Tensor]) -> Mask2Former:
    return mask2former_of(state)


def picture(height: int = 224, width: int = 224, seed: int = 1) -> torch.Tensor:
    return torch.randn((1, 3, height, width), generator=torch.Generator().manual_seed(seed))


def plain_attention(levels: int) -> tuple[DeformableAttention, torch.Tensor]:
    """Passes values through, looks at the places alone; and maps as tokens."""
    attention = DeformableAttention(16, 4, levels, 16)
    for parameter in attention.parameters():
        torch.nn.init.zeros_(parameter)
    for layer in (attention.value_proj, attention.output_proj):
        torch.nn.init.eye_(layer.weight)
    count = sum(rows * columns for rows, columns in GRIDS[:levels])
    return attention, torch.randn((2, count, 16), generator=torch.Generator().manual_seed(3))


def sampled(one: np.ndarray, x: float, y: float) -> np.ndarray:
    """Bilinear value of a map (C, h, w) at x, y in 0..1 of it, zero outside, by its definition."""
    total = np.zeros(len(one))
    u, v = x * one.shape[2] - 0.5, y * one.shape[1] - 0.5
    for row in (math.floor(v), math.floor(v) + 1):
        for column in (math.floor(u), math.floor(u) + 1):
            if 0 <= row < one.shape[1] and 0 <= column < one.shape[2]:
                total += (1 - abs(u - column)) * (1 - abs(v - row)) * one[:, row, column]
    return total


def test_without_offsets_attention_is_bilinear_sampling_at_the_places() -> None:
    attention, tokens = plain_attention(3)
    places = torch.rand((11, 2), generator=torch.Generator().manual_seed(4))
    places[0] = torch.tensor((0.01, 0.99))  # beyond the outermost centres
    with torch.no_grad():
        found = attention(torch.randn(2, 11, 16), places, tokens, GRIDS).numpy()
    maps = [one.numpy() for one in as_maps(tokens, GRIDS)]
    for batch in range(2):
        for query, (x, y) in enumerate(places.tolist()):
            expected = np.mean([sampled(one[batch], x, y) for one in maps], axis=0)
            np.testing.assert_allclose(found[batch, query], expected, atol=1e-5)


def test_offsets_count_cells_x_first() -> None:
    """All points of head 2 look one column to the right and two rows down; the other heads stay."""
    attention, tokens = plain_attention(1)
    bias = torch.zeros(4, 1, POINTS, 2)
    bias[2] = torch.tensor((1.0, 2.0))
    attention.sampling_offsets.bias.data = bias.flatten()
    with torch.no_grad():
        found = attention(torch.zeros(2, 63, 16), centres(GRIDS[:1], tokens), tokens, GRIDS[:1])
    whole = as_maps(tokens, GRIDS[:1])[0]
    (moved,) = as_maps(found, GRIDS[:1])
    torch.testing.assert_close(moved[:, :8], whole[:, :8], atol=1e-5, rtol=0)
    torch.testing.assert_close(moved[:, 8:12, :-2, :-1], whole[:, 8:12, 2:, 1:], atol=1e-5, rtol=0)
    assert not moved[:, 8:12, -2:].any() and not moved[:, 8:12, :, -1].any()


def test_the_learnt_weights_choose_the_map() -> None:
    attention, tokens = plain_attention(3)
    bias = torch.full((4, 3, POINTS), -50.0)
    bias[:, 1] = 0
    attention.attention_weights.bias.data = bias.flatten()
    with torch.no_grad():
        found = attention(torch.zeros(2, 20, 16), centres(GRIDS[1:2], tokens), tokens, GRIDS)
    torch.testing.assert_close(found, tokens[:, 63:83], atol=1e-5, rtol=0)


def test_maps_become_tokens_and_maps_again() -> None:
    maps = [torch.randn(2, 5, *grid) for grid in GRIDS]
    again = as_maps(as_tokens(maps), GRIDS)
    assert all(torch.equal(one, other) for one, other in zip(maps, again, strict=True))
    np.testing.assert_allclose(centres(GRIDS, maps[0])[10], ((1 + 0.5) / 9, (1 + 0.5) / 7))


def test_positions_are_waves_of_the_row_and_then_of_the_column() -> None:
    found = sine_positions((7, 9), 32, torch.zeros(1)).reshape(7, 9, 32)
    for row, column, channel in ((0, 0, 0), (3, 8, 5), (6, 2, 14), (2, 5, 16), (4, 4, 31)):
        count, size = (row + 1, 7) if channel < 16 else (column + 1, 9)
        angle = count / (size + 1e-6) * 2 * math.pi / 10000 ** (2 * (channel % 16 // 2) / 16)
        wave = math.cos(angle) if channel % 2 else math.sin(angle)
        np.testing.assert_allclose(found[row, column, channel], wave, atol=1e-5)


@pytest.mark.parametrize(("width", "heads", "hidden", "total"), [(1024, 32, 4096, 1.43e9), (1536, 24, 6144, 1.72e9)])
def test_the_full_size_has_as_many_parameters_as_published(width: int, heads: int, hidden: int, total: float) -> None:
    adapter = AdapterSize(width=1536, blocks=40, hidden=4096, groups=4, heads=24, values=768, convolved=384)
    head = HeadSize(width, width, heads, 6, 9, hidden, hidden, queries=100, classes=150)
    with torch.device("meta"):
        network = Mask2Former(adapter, head)
    assert round(sum(p.numel() for p in network.backbone.parameters()) / 1e6, 1) == 1186.8
    assert abs(sum(p.numel() for p in network.parameters()) - total) < 0.005e9


def test_the_sizes_are_those_of_the_tensors(network: Mask2Former, state: dict[str, torch.Tensor]) -> None:
    assert network.backbone.size == ADAPTER
    own = network.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(value, own[key]) for key, value in state.items())
    wider = HeadSize(64, 16, 8, 1, 3, 24, 40, queries=5, classes=3)
    shape = mask2former_of(random_state(Mask2Former(ADAPTER, wider)))(picture()).shape
    assert shape == (1, 3, 56, 56)


def test_maps_of_the_adapter_have_the_four_sizes(network: Mask2Former) -> None:
    maps = network.backbone(picture(224, 448))
    assert [tuple(one.shape) for one in maps] == [(1, 64, 224 // n, 448 // n) for n in (4, 8, 16, 32)]


def test_scores_are_finite_shares_for_each_picture_of_a_batch(network: Mask2Former) -> None:
    one, other = picture(seed=1), picture(seed=2)
    alone = network(one)
    both = network(torch.cat((other, one)))
    assert both.shape == (2, 7, 56, 56)
    assert both.isfinite().all() and both.min() >= 0
    torch.testing.assert_close(both[1:], alone, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(both[0], both[1], atol=1e-3)


def test_every_parameter_matters_and_every_statistic(state: dict[str, torch.Tensor]) -> None:
    """Unconnected parameters have no gradient; of the buffers only the counters are without influence."""
    network = mask2former_of(state).requires_grad_(True)
    scores = network(picture())
    (scores * torch.randn(scores.shape, generator=torch.Generator().manual_seed(5))).sum().backward()
    names = dict(network.named_parameters())
    assert len(names) > 300
    assert [name for name, p in names.items() if p.grad is None or not p.grad.abs().max() > 0] == []
    still = []
    with torch.inference_mode():
        before = network(picture())
        for name, buffer in network.named_buffers():
            kept = buffer.clone()
            buffer += 1
            if torch.equal(network(picture()), before):
                still.append(name)
            buffer.copy_(kept)
    counters = [name for name in state if name.endswith("num_batches_tracked")]
    assert still == counters and len(counters) == 10


def test_a_query_looks_where_its_mask_is_and_everywhere_when_that_is_nowhere(network: Mask2Former) -> None:
    masks = torch.full((1, 3, 8, 8), -4.0)
    masks[0, 0, :4, 4:] = 4.0
    masks[0, 1] = 4.0
    blocked = network.decode_head._blocked(masks, (2, 2))
    assert blocked.shape == (HEAD.heads, 3, 4)
    expected = torch.tensor([[True, False, True, True], [False] * 4, [False] * 4])
    assert all(torch.equal(one, expected) for one in blocked)


def inputs_of(modules: list[torch.nn.Module], run) -> list[tuple[torch.Tensor, ...]]:
    """Positional arguments of each call of the modules, in order of the calls."""
    seen: list[tuple[torch.Tensor, ...]] = []
    hooks = [module.register_forward_hook(lambda m, given, out: seen.append(given)) for module in modules]
    run()
    for hook in hooks:
        hook.remove()
    return seen


def test_queries_look_at_the_maps_in_turn_from_coarse_to_fine(network: Mask2Former) -> None:
    head = network.decode_head
    refined = []
    hook = head.pixel_decoder.register_forward_hook(lambda m, given, out: refined.extend(out[1]))
    calls = inputs_of(list(head.transformer_decoder.layers), lambda: network(picture()))
    hook.remove()
    assert [one.shape[-1] for one in refined] == [7, 14, 28]
    for index, (_, own, values, positions, blocked) in enumerate(calls):
        level = index % 3
        torch.testing.assert_close(values, as_tokens([refined[level]]) + head.level_embed.weight[level])
        torch.testing.assert_close(positions, sine_positions((7 * 2**level,) * 2, 32, values))
        assert torch.equal(own, head.query_embed.weight) and blocked.shape == (4, 9, values.shape[1])
    assert len(calls) == 4 and torch.equal(calls[0][0][0], head.query_feat.weight)


def test_the_pixel_decoder_takes_its_maps_from_coarse_to_fine(network: Mask2Former) -> None:
    decoder = network.decode_head.pixel_decoder
    calls = inputs_of([*decoder.input_convs, *decoder.lateral_convs], lambda: network(picture()))
    assert [given[0].shape[-1] for given in calls] == [7, 14, 28, 56]
    first, *_ = inputs_of([decoder.encoder], lambda: network(picture()))
    expected = [
        sine_positions((n, n), 32, first[0]) + decoder.level_encoding.weight[i] for i, n in enumerate((7, 14, 28))
    ]
    torch.testing.assert_close(first[1], torch.cat(expected))


def test_positions_are_added_to_queries_and_keys_but_not_to_values(network: Mask2Former) -> None:
    layer = network.decode_head.transformer_decoder.layers[0]
    x, own, values, positions = (torch.randn(1, n, 32) for n in (9, 9, 20, 20))
    cross, alone = inputs_of(list(layer.attentions), lambda: layer(x, own, values, positions, None))
    assert torch.equal(cross[0], x + own) and torch.equal(cross[1], values + positions)
    assert torch.equal(cross[2], values)
    assert torch.equal(alone[0], alone[1]) and torch.equal(alone[0], alone[2] + own)


def test_blocks_and_extractors_come_in_their_order(network: Mask2Former) -> None:
    backbone, order = network.backbone, []
    names = {name: m for name, m in backbone.named_modules() if name.count(".") == 1 and name.startswith("blocks.")}
    names |= {
        n: m for n, m in backbone.named_modules() if n.endswith(("injector", "extractor", "tractors.0", "tractors.1"))
    }
    hooks = [m.register_forward_hook(lambda *_, name=name: order.append(name)) for name, m in names.items()]
    backbone(picture())
    for hook in hooks:
        hook.remove()
    expected = [
        name for i in range(4) for name in (f"interactions.{i}.injector", f"blocks.{i}", f"interactions.{i}.extractor")
    ]
    assert order == [*expected, "interactions.3.extra_extractors.0", "interactions.3.extra_extractors.1"]


def test_the_first_of_the_two_gates_goes_through_silu(network: Mask2Former) -> None:
    mlp, x = network.backbone.blocks[0].mlp, torch.randn(1, 5, 64)
    gate = mlp.w1(x)
    torch.testing.assert_close(mlp(x), mlp.w3(gate * gate.sigmoid() * mlp.w2(x)))


def test_the_last_class_means_nothing_there(state: dict[str, torch.Tensor]) -> None:
    bias = "decode_head.cls_embed.bias"
    empty = mask2former_of({**state, bias: state[bias] + 50 * F.one_hot(torch.tensor(7), 8)})
    assert empty(picture()).max() < 1e-6


def test_labels_of_a_picture_of_any_size(network: Mask2Former) -> None:
    rgb = golden_rule.image(150, 250)
    labels = segment_by_masks(network, rgb)
    assert labels.shape == (150, 250) and labels.dtype == np.int16
    padded = F.pad(torch.from_numpy(golden_rule.chw(rgb, *golden_rule.IMAGENET)), (0, 448 - 250, 0, 224 - 150))
    full = F.interpolate(network(padded), size=(224, 448), mode="bilinear", align_corners=False)[0, :, :150, :250]
    best = full.topk(2, dim=0)
    clear = (best.values[0] - best.values[1] > 1e-5).numpy()
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(labels[clear], best.indices[0].numpy()[clear])


def test_what_does_not_fit_is_said(network: Mask2Former, state: dict[str, torch.Tensor]) -> None:
    with pytest.raises(InputError, match="multiples of 14 and 32"):
        network(picture(224, 256))
    with pytest.raises(InputError, match="float64"):
        segment_by_masks(network, np.zeros((40, 40, 3)))
    with pytest.raises(WeightsError, match="no cls_token"):
        mask2former_of({"pretrained.cls_token": torch.zeros(1)})
    missing = "decode_head.transformer_decoder.layers.2.norms.1.bias"
    with pytest.raises(WeightsError, match=f"missing, the first {missing}"):
        mask2former_of({key: value for key, value in state.items() if key != missing})
