# SPDX-License-Identifier: Apache-2.0
"""The two-view network computes what the published ones do, from files of every layout, and refuses what cannot be."""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import golden_rule
import numpy as np
import pytest
import torch
from golden_rule import chw, compare, image, keys, unit
from network_weights import TWO_VIEW, two_view_architecture, two_view_tensors, with_aliases
from safetensors.torch import save_file

from bench.two_view import counted, measured, random_network, stages
from garps_core.errors import InputError, WeightsError
from garps_core.models.convert import needed
from garps_core.models.two_view import (
    Architecture,
    CrossAttention,
    Stack,
    TwoView,
    architecture_of,
    built_from,
    rotated,
    rotation,
)
from garps_core.weights.reader import read_tensors

MAST3R, DPT, LINEAR = TWO_VIEW
FULL = "mast3r_full"
SIZES = {MAST3R: ("96x128", "144x112"), DPT: ("112x144", "128x96"), LINEAR: ("112x144", "128x96")}
COUNT = {MAST3R: 79, DPT: 69, LINEAR: 43, FULL: 87}
"""Tensors in each golden file."""
HALF = ((0.5,) * 3, (0.5,) * 3)
FUSED = (("layer", "_rn"), ("refinenet", ""))
Tensors = dict[str, torch.Tensor]


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def held() -> dict[str, Tensors]:
    """Tensors of each reduced network."""
    return {name: two_view_tensors(name) for name in TWO_VIEW}


@pytest.fixture(scope="module")
def networks(held: dict[str, Tensors]) -> dict[str, TwoView]:
    return {name: built_from(held[name], two_view_architecture(name)) for name in TWO_VIEW}


def views(size: str) -> torch.Tensor:
    """The two golden pictures of a size, (2, 3, h, w)."""
    h, w = map(int, size.split("x"))
    pictures = image(h, w), image(h, w, 16, 8, "image2")
    return torch.from_numpy(np.concatenate([chw(picture, *HALF) for picture in pictures]))


def grid_of(size: str) -> tuple[int, int]:
    rows, columns = (int(side) // 16 for side in size.split("x"))
    return rows, columns


def passed(network: TwoView, size: str) -> list[torch.Tensor]:
    """All outputs of a pair, first and second view one after another."""
    with torch.inference_mode():
        tokens = network.encode(views(size))
        maps = network.decode(tokens[:1], grid_of(size), tokens[1:], grid_of(size))
    return [value for view in maps for value in vars(view).values() if value is not None]


def golden_modules(network: TwoView) -> dict[str, torch.nn.Module]:
    """Name in the golden file -> module whose output it is."""
    named = {f"enc.block{i}": block for i, block in enumerate(network.enc_blocks)} | {"enc.norm": network.enc_norm}
    for stream, blocks in (("dec1", network.dec_blocks), ("dec2", network.dec_blocks2)):
        named |= {f"{stream}.block{i}": block for i, block in enumerate(blocks)}
    for name, head in (("head1", network.downstream_head1), ("head2", network.downstream_head2)):
        if network.architecture.linear:
            named[f"{name}.proj"] = head.proj
            continue
        named[f"{name}.raw"] = head.dpt
        named |= {f"{name}.act{i}": part for i, part in enumerate(head.dpt.act_postprocess)}
        scratch = head.dpt.scratch
        named |= {f"{name}.{p}{i}{end}": getattr(scratch, f"{p}{i}{end}") for i in (1, 2, 3, 4) for p, end in FUSED}
        if head.head_local_features is not None:
            named[f"{name}.local"] = head.head_local_features
    return named


def recorded(network: TwoView, size: str) -> Tensors:
    """Every golden tensor of one pass."""
    ours: Tensors = {}

    def record(name: str) -> Callable[..., None]:
        return lambda _module, _given, out: ours.update({f"{size}.{name}": out})

    hooks = [module.register_forward_hook(record(name)) for name, module in golden_modules(network).items()]
    first = network.enc_blocks[0]
    hooks.append(first.register_forward_pre_hook(lambda _, given: ours.update({f"{size}.patches": given[0]})))
    with torch.inference_mode():
        tokens = network.encode(views(size))
        seen = network.decode(tokens[:1], grid_of(size), tokens[1:], grid_of(size))
    for hook in hooks:
        hook.remove()
    for i, (maps, points) in enumerate(zip(seen, ("pts3d", "pts3d_in_other_view"), strict=True), 1):
        found = {points: maps.points, "conf": maps.confidence}
        found |= {"desc": maps.descriptors, "desc_conf": maps.descriptor_confidence}
        ours |= {f"{size}.out{i}.{name}": value for name, value in found.items() if value is not None}
    return ours


def golden_names(name: str, size: str) -> list[str]:
    with np.load(golden_rule.FOLDER / f"{name}.npz") as z:
        return [tensor for tensor in z.files if tensor.startswith(f"{size}.")]


def compared(name: str, network: TwoView, sizes: tuple[str, ...]) -> None:
    """All that the golden file has, and nothing left out."""
    ratio = {}
    for size in sizes:
        ours = recorded(network, size)
        ratio |= compare(name, {tensor: ours[tensor] for tensor in golden_names(name, size)})
    assert len(ratio) == COUNT[name] - 1
    worst = max(ratio, key=lambda tensor: ratio[tensor])
    print(f"{name}: {len(ratio)} tensors, largest error / tolerance {ratio[worst]:.2f} ({worst})")


@pytest.mark.parametrize("name", TWO_VIEW)
def test_positions_turn_channels_as_published(name: str) -> None:
    x = torch.from_numpy(unit("rope", 768).astype(np.float32)).reshape(1, 2, 6, 64)
    assert len(compare(name, {"rope": rotated(x, rotation((2, 3), 64))})) == 1


@pytest.mark.parametrize("name", TWO_VIEW)
def test_golden_values_of_every_part(networks: dict[str, TwoView], name: str) -> None:
    compared(name, networks[name], SIZES[name])


def write_torch(path: Path, name: str, tensors: Tensors) -> None:
    """The authors' files hold a namespace beside the tensors, some of which have two names."""
    args = argparse.Namespace(model="a call that nobody may evaluate", lr=1e-4)
    torch.save({"args": args, "model": with_aliases(name, tensors), "epoch": 3}, path)


LAYOUTS: dict[str, Callable[[Path, str, Tensors], None]] = {
    "official.pth": write_torch,
    "plain.pth": lambda path, name, tensors: torch.save(with_aliases(name, tensors), path),
    "hub.safetensors": lambda path, name, tensors: save_file(tensors, path),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", TWO_VIEW)
def test_files_of_every_layout_hold_the_same_network(
    networks: dict[str, TwoView], held: dict[str, Tensors], tmp_path: Path, name: str, layout: str
) -> None:
    path = tmp_path / layout
    LAYOUTS[layout](path, name, held[name])
    read = read_tensors(path, kind=TWO_VIEW[name]).tensors
    assert len(read) == len(held[name]) + (len(keys(name)["aliases"]) if layout.endswith(".pth") else 0)
    built = built_from(read, two_view_architecture(name))
    twin = networks[name].state_dict()
    assert all(torch.equal(value, twin[key]) for key, value in built.state_dict().items())
    assert not built.training and not any(parameter.requires_grad for parameter in built.parameters())
    kept, _ = needed(TWO_VIEW[name], read)
    assert set(kept) == set(built.state_dict())


@pytest.mark.parametrize("name", TWO_VIEW)
def test_what_is_said_to_be_unused_is_unused(networks: dict[str, TwoView], held: dict[str, Tensors], name: str) -> None:
    unused = keys(name)["unused"]["model"]
    zeros = built_from(
        held[name] | {key: torch.zeros_like(held[name][key]) for key in unused}, two_view_architecture(name)
    )
    size = SIZES[name][1]
    assert all(torch.equal(a, b) for a, b in zip(passed(zeros, size), passed(networks[name], size), strict=True))
    without = {key: value for key, value in held[name].items() if key != "mask_token"}
    assert not built_from(without, two_view_architecture(name)).mask_token.any()


def test_a_batch_is_its_pairs_one_by_one(networks: dict[str, TwoView]) -> None:
    network, size = networks[MAST3R], SIZES[MAST3R][1]
    grid = grid_of(size)
    with torch.inference_mode():
        together = network.encode(views(size))
        apart = torch.cat([network.encode(one[None]) for one in views(size)])
        torch.testing.assert_close(together, apart, rtol=1e-5, atol=1e-5)
        both = network.decode(together, grid, together.flip(0), grid)
        for i in (0, 1):
            alone = network.decode(together[i : i + 1], grid, together[1 - i : 2 - i], grid)
            for many, one in zip(both, alone, strict=True):
                for name, value in vars(one).items():
                    torch.testing.assert_close(getattr(many, name)[i : i + 1], value, rtol=1e-4, atol=1e-4)


def test_views_of_different_sizes_meet(networks: dict[str, TwoView]) -> None:
    """Each view's maps have its own size, and what the first sees does depend on the second."""
    network = networks[DPT]
    wide, tall = (views(size)[:1] for size in ("112x144", "144x112"))
    with torch.inference_mode():
        tokens = network.encode(wide), network.encode(tall)
        one, two = network.decode(tokens[0], (7, 9), tokens[1], (9, 7))
        other, _ = network.decode(tokens[0], (7, 9), tokens[0], (7, 9))
    assert one.points.shape == (1, 112, 144, 3) and one.confidence.shape == (1, 112, 144)
    assert two.points.shape == (1, 144, 112, 3) and two.descriptors is None
    assert (one.points - other.points).abs().max() > 1e-3


def test_every_view_is_turned_by_its_own_places(networks: dict[str, TwoView]) -> None:
    """With views of different sizes, queries turn by their own view's grid and keys by the other's."""
    torch.manual_seed(0)
    look, x, other = CrossAttention(64, 1), torch.randn(1, 6, 64), torch.randn(1, 8, 64)
    turn, other_turn = rotation((2, 3), 64), rotation((4, 2), 64)
    q, k = rotated(look.projq(x)[:, None], turn)[0, 0], rotated(look.projk(other)[:, None], other_turn)[0, 0]
    expected = look.proj((q @ k.T / 8).softmax(-1) @ look.projv(other))
    torch.testing.assert_close(look(x, other, turn, other_turn), expected, rtol=1e-5, atol=1e-6)
    network, given = networks[LINEAR], []
    blocks = network.dec_blocks[1], network.dec_blocks2[1]
    hooks = [block.register_forward_pre_hook(lambda _, args: given.append(args)) for block in blocks]
    with torch.inference_mode():
        network.decode(torch.randn(1, 6, 128), (2, 3), torch.randn(1, 8, 128), (4, 2))
    for hook in hooks:
        hook.remove()
    width = 96 // 3
    for args, own, others in zip(given, ((2, 3), (4, 2)), ((4, 2), (2, 3)), strict=True):
        assert [len(tokens[0]) for tokens in args[:2]] == [own[0] * own[1], others[0] * others[1]]
        assert torch.equal(args[2][0], rotation(own, width)[0]) and torch.equal(args[3][0], rotation(others, width)[0])


def test_other_sides_are_refused(networks: dict[str, TwoView]) -> None:
    with pytest.raises(InputError, match=r"100x128 pixels \(rows x columns\): expected multiples of 16"):
        networks[MAST3R].encode(torch.zeros(1, 3, 100, 128))


def test_one_decoder_serves_both_views_where_a_file_has_only_one(held: dict[str, Tensors]) -> None:
    single = {key: value for key, value in held[LINEAR].items() if not key.startswith("dec_blocks2.")}
    built = built_from(single, two_view_architecture(LINEAR)).state_dict()
    for key in single:
        assert torch.equal(built[key.replace("dec_blocks.", "dec_blocks2.")], single[key])


@pytest.mark.parametrize(
    ("linear", "descriptors", "parameters"), [(False, 24, 688.6e6), (False, 0, 571.2e6), (True, 0, 532.3e6)]
)
def test_published_numbers_of_parameters_and_sizes_told_from_shapes(
    linear: bool, descriptors: int, parameters: float
) -> None:
    given = Architecture(linear=linear, descriptors=descriptors)
    with torch.device("meta"):
        network = TwoView(given)
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(parameters, rel=1e-3)
    assert architecture_of(network.state_dict()) == given


def changed(tensors: Tensors, **new: torch.Tensor | None) -> Tensors:
    """Replace tensors, or leave them out where None; in the names a double underscore stands for a point."""
    everything = tensors | {key.replace("__", "."): value for key, value in new.items()}
    return {key: value for key, value in everything.items() if value is not None}


BAD = {
    "one missing": ({"dec_norm__bias": None}, r"MASt3R: 1 of 757 tensors are missing, the first dec_norm\.bias"),
    "one too many": ({"prediction_head__bias": torch.ones(3)}, r"1 are unexpected, the first prediction_head\.bias"),
    "of another shape": ({"enc_norm__bias": torch.ones(4)}, r"another shape, the first enc_norm\.bias: 4 float32"),
    "not finite": ({"enc_norm__bias": torch.full((128,), torch.nan)}, r"enc_norm\.bias has 128 of 128 values"),
    "an alias that differs": (
        {"downstream_head1__dpt__scratch__layer_rn__0__weight": torch.zeros(256, 96, 3, 3)},
        r"layer_rn\.0\.weight differs from downstream_head1\.dpt\.scratch\.layer1_rn\.weight",
    ),
}


@pytest.mark.parametrize(("new", "message"), BAD.values(), ids=BAD)
def test_weights_that_do_not_fit_are_refused(held: dict[str, Tensors], new: Tensors, message: str) -> None:
    with pytest.raises(WeightsError, match=message):
        built_from(changed(held[MAST3R], **new), two_view_architecture(MAST3R))


UNTELLING = {
    "nothing": ({}, "is a network that is not known here by its names: expected MASt3R or DUSt3R"),
    "no patches": ({"downstream_head1.proj.weight": torch.ones(1)}, r"patch_embed\.proj\.weight is missing"),
    "a scalar": (
        {"downstream_head1.proj.weight": torch.ones(1), "patch_embed.proj.weight": torch.ones(())},
        r"patch_embed\.proj\.weight has 0 dimensions: expected 4",
    ),
    "no width": (
        {"downstream_head1.proj.weight": torch.ones(1), "patch_embed.proj.weight": torch.ones(0, 3, 16, 16)},
        "enc_blocks of width 0, 0 of them",
    ),
}


@pytest.mark.parametrize(("tensors", "message"), UNTELLING.values(), ids=UNTELLING)
def test_shapes_that_tell_of_no_network_are_refused(tensors: Tensors, message: str) -> None:
    with pytest.raises(WeightsError, match=message):
        built_from(tensors)


def test_absurd_sizes_are_refused_before_anything_is_built(held: dict[str, Tensors]) -> None:
    with pytest.raises(WeightsError, match="dec_blocks of width 96, 12 of them: expected a multiple of 64"):
        built_from(held[LINEAR])
    many = {f"enc_blocks.{i}.norm1.bias": torch.ones(1) for i in range(1000)}
    with pytest.raises(WeightsError, match=r"enc_blocks of width 128, 1000 of them.*at most 64"):
        built_from(held[LINEAR] | many)


def test_the_descriptors_are_counted_in_the_file() -> None:
    small = Architecture(Stack(64, 1, 1), Stack(64, 2, 1), descriptors=3)
    network = TwoView(small)
    assert architecture_of(network.state_dict()) == small
    built = built_from(network.state_dict())
    with torch.inference_mode():
        tokens = built.encode(torch.zeros(1, 3, 16, 32))
        maps, _ = built.decode(tokens, (1, 2), tokens, (1, 2))
    assert maps.descriptors is not None and maps.descriptors.shape == (1, 16, 32, 3)


def test_the_benchmark_runs_what_garps_runs() -> None:
    """Its stages are those of a pair, on a network whose random output is finite."""
    network = random_network(Architecture(Stack(64, 1, 1), Stack(64, 1, 1), linear=True))
    found = {}
    with torch.inference_mode():
        for name, call in stages(network, [image(60, 80), image(60, 80, 9)]).items():
            row = counted(measured(name, call, runs=1), call)
            found[name] = row["GFLOP"]
            assert row["CPU s"] >= 0 and row["peak MiB"] > 0
    prepare, encode, decode, heads, whole = found.values()
    assert prepare == 0 < heads < decode
    assert whole == pytest.approx(encode + decode)


@pytest.mark.skipif(os.environ.get("GARPS_LARGE_TESTS") != "1", reason="GARPS_LARGE_TESTS=1: 6 GB and minutes")
def test_golden_values_at_full_size() -> None:
    start = time.perf_counter()
    tensors = two_view_tensors(FULL)
    network = built_from(tensors)
    assert network.architecture == two_view_architecture(FULL) == Architecture(descriptors=24)
    del tensors
    built = time.perf_counter()
    compared(FULL, network, ("288x512",))
    print(f"filled and built in {built - start:.0f} s, passed in {time.perf_counter() - built:.0f} s")
