# SPDX-License-Identifier: Apache-2.0
"""Inputs of MASt3R and DUSt3R; both orders of a pair agree however they are computed."""

from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from golden_rule import chw, image
from network_weights import TWO_VIEW, two_view_architecture, two_view_tensors
from safetensors.torch import save_file

from garps_core.errors import ConfigError, InputError, ModelError
from garps_core.models.check import check_file
from garps_core.models.mast3r import KEPT, NaverModel, cropped_input, square_input
from garps_core.models.two_view import Architecture, Stack, TwoView, built_from
from garps_core.point_maps import PairMaps, PointMap, TwoViewModel

MAST3R, DPT, LINEAR = TWO_VIEW
SIDE = 128
"""Longer side of the resized pictures here; published networks see 512."""
PICTURES = {"a": image(60, 80), "b": image(60, 80, 16, 8, "image2"), "tall": image(80, 50), "large": image(150, 200, 9)}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def networks() -> dict[str, TwoView]:
    return {name: built_from(two_view_tensors(name), two_view_architecture(name)) for name in TWO_VIEW}


TINY = Architecture(Stack(64, 1, 1), Stack(64, 1, 1), descriptors=5)


@pytest.fixture
def tiny() -> TwoView:
    """A network of random parameters, where the test does not depend on them."""
    torch.manual_seed(0)
    return TwoView(TINY).eval().requires_grad_(False)


def model(network: TwoView, variant: str = "", dtype: torch.dtype = torch.float32) -> NaverModel:
    return NaverModel(network, variant, dtype, long_side=SIDE)


SEEN = {  # picture -> resized, offset (x, y), seen; rows x columns
    (360, 640): ((288, 512), (0, 0), (288, 512)),
    (480, 640): ((384, 512), (0, 0), (384, 512)),
    (640, 480): ((512, 384), (0, 0), (512, 384)),
    (720, 1280): ((288, 512), (0, 0), (288, 512)),
    (500, 750): ((341, 512), (0, 2), (336, 512)),
    (741, 999): ((380, 512), (0, 6), (368, 512)),
    (999, 740): ((512, 379), (5, 0), (512, 368)),
    (500, 500): ((512, 512), (0, 64), (384, 512)),
    (700, 700): ((512, 512), (0, 64), (384, 512)),
    (999, 1000): ((511, 512), (0, 7), (496, 512)),
    (512, 512): ((512, 512), (0, 64), (384, 512)),
    (17, 20): ((435, 512), (0, 1), (432, 512)),
    (16, 128): ((64, 512), (0, 0), (64, 512)),
}


@pytest.mark.parametrize(("size", "expected"), SEEN.items())
def test_pictures_are_resized_and_cut_as_published(size, expected) -> None:
    """Against the published recipe with the library it was made with."""
    pillow = pytest.importorskip("PIL.Image")
    resized, (left, top), (rows, columns) = expected
    rgb = image(*size)
    method = pillow.Resampling.LANCZOS if max(size) > 512 else pillow.Resampling.BICUBIC
    cut = pillow.fromarray(rgb).resize(resized[::-1], method).crop((left, top, left + columns, top + rows))
    seen, framing = cropped_input(rgb)
    assert framing.size == seen.shape[1:] == (rows, columns)
    assert framing.offset == (left, top)
    assert framing.scale == (resized[1] / size[1], resized[0] / size[0])
    np.testing.assert_array_equal(seen, chw(np.asarray(cut), (0.5,) * 3, (0.5,) * 3)[0])


SQUARES = {
    (360, 640): ((224, 398), (87, 0)),
    (640, 361): ((397, 224), (0, 86)),
    (224, 224): ((224, 224), (0, 0)),
    (100, 103): ((224, 231), (3, 0)),
    (17, 20): ((224, 264), (20, 0)),
}


@pytest.mark.parametrize(("size", "expected"), SQUARES.items())
def test_the_variant_of_squares_sees_the_middle(size, expected) -> None:
    pillow = pytest.importorskip("PIL.Image")
    resized, (left, top) = expected
    rgb = image(*size)
    method = pillow.Resampling.LANCZOS if max(size) > max(resized) else pillow.Resampling.BICUBIC
    cut = pillow.fromarray(rgb).resize(resized[::-1], method).crop((left, top, left + 224, top + 224))
    seen, framing = square_input(rgb, 224)
    assert (framing.size, framing.offset) == ((224, 224), (left, top))
    assert framing.scale == (resized[1] / size[1], resized[0] / size[0])
    np.testing.assert_array_equal(seen, chw(np.asarray(cut), (0.5,) * 3, (0.5,) * 3)[0])


def test_the_framing_says_where_a_pixel_went() -> None:
    """A bright spot of a picture is found where the framing says, for both axes and a cut."""
    rgb = np.zeros((500, 750, 3), np.uint8)
    rgb[100:104, 600:604] = 255
    seen, framing = cropped_input(rgb)
    y, x = np.mgrid[: seen.shape[1], : seen.shape[2]]
    weight = (seen[0].numpy() + 1).clip(0)
    centre = np.array([[(weight * x).sum(), (weight * y).sum()]]) / weight.sum()
    np.testing.assert_allclose(framing.to_image(centre), [[601.5, 101.5]], atol=0.1)


BAD = {
    "smaller than a patch": (np.zeros((15, 80, 3), np.uint8), "80x15 pixels: expected at least 16x16"),
    "empty": (np.zeros((0, 80, 3), np.uint8), "80x0 pixels: expected at least 16x16"),
    "a line": (np.zeros((20, 161, 3), np.uint8), "161x20 pixels: .* at most 8 to 1. Crop"),
    "a column": (np.zeros((161, 20, 3), np.uint8), "20x161 pixels: .* at most 8 to 1. Crop"),
    "float": (np.zeros((60, 80, 3), np.float32), "float32.*HxWx3 uint8"),
    "grey": (np.zeros((60, 80), np.uint8), r"uint8 \(60, 80\).*HxWx3"),
}


@pytest.mark.parametrize(("given", "message"), BAD.values(), ids=BAD)
@pytest.mark.parametrize("variant", ["", "linear-224"])
def test_pictures_that_cannot_be_are_refused(tiny: TwoView, given, message: str, variant: str) -> None:
    with pytest.raises(InputError, match=message):
        model(tiny, variant)(PICTURES["a"], given)


def test_types_that_cannot_be_are_refused(tiny: TwoView) -> None:
    with pytest.raises(ConfigError, match=r"torch\.int8.*float16"):
        model(tiny, dtype=torch.int8)


def maps_of(found: PairMaps) -> list[PointMap]:
    return [*found.source_first, *found.target_first]


def largest_difference(one: PairMaps, other: PairMaps) -> float:
    """Largest difference of all values, relative to the largest of their kind."""
    assert one.framings == other.framings
    worst = 0.0
    for a, b in zip(maps_of(one), maps_of(other), strict=True):
        for ours, theirs in zip(vars(a).values(), vars(b).values(), strict=True):
            if ours is not None:
                worst = max(worst, float(np.abs(ours - theirs).max() / np.abs(theirs).max()))
    return worst


def one_by_one(network: TwoView, source, target) -> PairMaps:
    """The plain way: each order alone, each picture encoded anew."""
    seen, framings = zip(*(cropped_input(picture, SIDE) for picture in (source, target)), strict=True)
    grids = [(framing.size[0] // 16, framing.size[1] // 16) for framing in framings]
    orders = []
    for i, j in ((0, 1), (1, 0)):
        with torch.inference_mode():
            views = network.decode(network.encode(seen[i][None]), grids[i], network.encode(seen[j][None]), grids[j])
        parts = [(maps.points, maps.confidence, maps.descriptors) for maps in views]
        orders.append(tuple(PointMap(*(None if v is None else v[0].numpy() for v in view)) for view in parts))
    metric = network.architecture.descriptors > 0
    return PairMaps(*orders, framings, metric, "mast3r" if metric else "dust3r")


PAIRS = {"alike": ("a", "b"), "of different sizes": ("a", "tall"), "of one network size": ("b", "large")}


@pytest.mark.parametrize(("source", "target"), PAIRS.values(), ids=PAIRS)
@pytest.mark.parametrize("name", TWO_VIEW)
def test_both_orders_are_those_of_single_passes(
    networks: dict[str, TwoView], name: str, source: str, target: str
) -> None:
    one, two = PICTURES[source], PICTURES[target]
    asked: TwoViewModel = model(networks[name])
    found, plain = asked(one, two), one_by_one(networks[name], one, two)
    assert largest_difference(found, plain) < 1e-5
    assert (found.metric, found.origin) == (plain.metric, plain.origin) == (name == MAST3R, TWO_VIEW[name])
    sizes = [framing.size for framing in found.framings]
    for maps, size in zip(maps_of(found), [*sizes, *sizes[::-1]], strict=True):
        assert maps.points.shape == (*size, 3) and maps.confidence.shape == size
        assert (maps.descriptors is None) == (name != MAST3R)
        for values in vars(maps).values():
            assert values is None or (values.dtype == np.float32 and values.flags.c_contiguous)
        if maps.descriptors is not None:
            np.testing.assert_allclose(np.linalg.norm(maps.descriptors, axis=-1), 1, atol=1e-5)
        assert maps.confidence.min() >= 1


def test_the_orders_differ(networks: dict[str, TwoView]) -> None:
    """The outputs differ, so that no test here holds because everything is equal."""
    found = model(networks[MAST3R])(PICTURES["a"], PICTURES["b"])
    assert np.abs(found.source_first[0].points - found.target_first[1].points).max() > 1e-2
    assert np.abs(found.source_first[0].points - found.source_first[1].points).max() > 1e-2


@contextmanager
def calls(network: TwoView) -> Iterator[dict[str, list[int]]]:
    """Sizes of the batches that enter the encoder and the decoders."""
    seen: dict[str, list[int]] = {"encode": [], "decode": []}
    parts = {"encode": network.patch_embed, "decode": network.dec_blocks[0]}
    hooks = [
        part.register_forward_pre_hook(lambda _, given, name=name: seen[name].append(len(given[0])))
        for name, part in parts.items()
    ]
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


def test_a_picture_is_encoded_once(tiny: TwoView) -> None:
    asked = model(tiny)
    a, b, tall = PICTURES["a"], PICTURES["b"], PICTURES["tall"]
    steps = (
        ((a, b), [2], [2]),
        ((b, a.copy()), [], [2]),
        ((b, tall), [1], [1, 1]),
        ((tall, tall), [], [2]),
        ((a, b), [], [2]),
    )
    for pair, encoded, decoded in steps:
        with calls(tiny) as seen:
            asked(*pair)
        assert seen == {"encode": encoded, "decode": decoded}


def test_the_oldest_pictures_are_forgotten(tiny: TwoView) -> None:
    asked = model(tiny)
    pictures = [image(60, 80, x0=9 * i) for i in range(KEPT + 1)]
    for i in range(KEPT):
        asked(pictures[i], pictures[i + 1])
    with calls(tiny) as seen:
        asked(pictures[KEPT], pictures[1])
        asked(pictures[0], pictures[1])
    assert seen["encode"] == [1]


def test_what_is_kept_changes_nothing(networks: dict[str, TwoView]) -> None:
    asked = model(networks[MAST3R])
    a, b = PICTURES["a"], PICTURES["b"]
    first = asked(a, b)
    asked(b, PICTURES["tall"])
    again, fresh = asked(a, b), model(networks[MAST3R])(a, b)
    assert largest_difference(again, first) == 0
    assert largest_difference(fresh, first) == 0
    partly = model(networks[MAST3R])
    partly(PICTURES["tall"], a)
    assert largest_difference(partly(a, b), first) < 1e-5


def test_a_changed_picture_is_another(networks: dict[str, TwoView]) -> None:
    """Not the object counts but its content, and its shape too."""
    asked = model(networks[DPT])
    picture = PICTURES["a"].copy()
    before = asked(picture, PICTURES["b"])
    picture[:30] = 255 - picture[:30]
    assert largest_difference(asked(picture, PICTURES["b"]), before) > 1e-3
    assert asked(picture.reshape(80, 60, 3), PICTURES["b"]).framings[0].size == (128, 96)


def test_a_small_square_is_seen_by_its_variant(networks: dict[str, TwoView]) -> None:
    found = NaverModel(networks[LINEAR], "linear-224")(PICTURES["a"], PICTURES["tall"])
    assert [framing.size for framing in found.framings] == [(224, 224)] * 2
    assert found.source_first[1].points.shape == (224, 224, 3)


def out_of_memory_above(limit: int):
    """A hook that fails as a device does when a batch is larger."""

    def check(_module, given) -> None:
        if len(given[0]) > limit:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    return check


@pytest.mark.parametrize("part", ["patch_embed", "decoder_embed"])
def test_where_two_do_not_fit_in_memory_one_by_one_do(networks: dict[str, TwoView], part: str) -> None:
    network, a, b = networks[DPT], PICTURES["a"], PICTURES["b"]
    expected = model(network)(a, b)
    hook = getattr(network, part).register_forward_pre_hook(out_of_memory_above(1))
    try:
        found = model(network)(a, b)
    finally:
        hook.remove()
    assert largest_difference(found, expected) < 1e-5


@pytest.mark.parametrize("part", ["patch_embed", "decoder_embed"])
def test_where_not_even_one_fits_in_memory_the_error_says_so(tiny: TwoView, part: str) -> None:
    getattr(tiny, part).register_forward_pre_hook(out_of_memory_above(0))
    with pytest.raises(ModelError, match=r"out of memory on cpu with one pair.*float16"):
        model(tiny)(PICTURES["a"], PICTURES["b"])


@pytest.mark.parametrize("part", ["dpt.head.4", "head_local_features.fc2"])
def test_values_that_are_no_numbers_are_an_error(tiny: TwoView, part: str) -> None:
    tiny.downstream_head2.get_submodule(part).bias.fill_(torch.inf)
    with pytest.raises(ModelError, match=r"NaN or infinity in torch\.float32"):
        model(tiny)(PICTURES["a"], PICTURES["b"])


@pytest.mark.parametrize(("dtype", "bound"), [(torch.bfloat16, 0.1), (torch.float16, 0.02)])
def test_what_half_precision_costs(networks: dict[str, TwoView], dtype: torch.dtype, bound: float) -> None:
    """An upper bound of order, with pseudo-random weights. The heads get, and give, float32."""
    pair = PICTURES["a"], PICTURES["b"]
    full, half = model(networks[MAST3R])(*pair), model(networks[MAST3R], dtype=dtype)(*pair)
    for one, other in zip(maps_of(full), maps_of(half), strict=True):
        length = np.linalg.norm(one.points, axis=-1)
        error = np.linalg.norm(one.points - other.points, axis=-1) / length
        print(f"{dtype}: median {np.median(error):.2%}, 99 % {np.quantile(error, 0.99):.2%}")
        assert 0 < np.median(error) < bound
        assert other.points.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(other.descriptors, axis=-1), 1, atol=1e-5)


def check(path: Path, kind: str) -> dict[str, tuple[str, bool]]:
    return {name: (words, good) for name, words, good in check_file(path, kind=kind)}


PLAUSIBLE = {"linear": Architecture(Stack(64, 1, 1), Stack(64, 1, 1), linear=True), "mast3r": TINY}


@pytest.mark.parametrize("kind", PLAUSIBLE)
def test_check_says_what_a_file_sees(tmp_path: Path, kind: str) -> None:
    """Noise fits, but no room is that near."""
    torch.manual_seed(3)
    network, path = TwoView(PLAUSIBLE[kind]), tmp_path / "mine.pth"
    torch.save({"args": Namespace(), "model": network.state_dict()}, path)
    found = check(path, "mast3r" if kind == "mast3r" else "dust3r")
    assert found["shapes"][0].endswith("5 descriptors" if kind == "mast3r" else "no descriptors")
    assert "encoder 64 x 1, decoder 64 x 1" in found["shapes"][0]
    assert found["shapes"][1] and found["values"][1] and found["confidence"][1]
    assert not found["depth"][1]
    assert ("units of its own" in found["depth"][0]) == (kind == "linear")
    assert ("descriptors" in found) == (kind == "mast3r")


def test_check_believes_what_can_be_true(tmp_path: Path) -> None:
    """Every pixel 2 m ahead and surely so; only its likeness with the room gives it away."""
    network, path = TwoView(PLAUSIBLE["linear"]), tmp_path / "mine.safetensors"
    for head in (network.downstream_head1, network.downstream_head2):
        head.proj.weight.data.zero_()
        head.proj.bias.data = torch.tensor([0.0, 0.0, 1.0, 1.0]).repeat_interleave(256)
    save_file(network.state_dict(), path)
    found = check(path, "dust3r")
    assert [name for name, (_, good) in found.items() if not good] == ["likeness"]
    assert found["depth"][0].startswith("1.72 .. 1.72 .. 1.72")
    assert found["confidence"][0] == "at least 3.72, 3.72 in the median"


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_gives_the_same(networks: dict[str, TwoView]) -> None:
    asked = model(networks[DPT])
    here = asked(PICTURES["a"], PICTURES["b"])
    try:
        networks[DPT].to("cuda")
        there = asked(PICTURES["a"], PICTURES["b"])
    finally:
        networks[DPT].to("cpu")
    assert largest_difference(there, here) < 0.02
