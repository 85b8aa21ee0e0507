# SPDX-License-Identifier: Apache-2.0
"""Splat files read back: our own, those of an independent writer, and damaged ones."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_splats import random_mixture

from garps_core import Config
from garps_core.errors import InputError
from garps_core.mixtures.reconstruct import reconstruct
from garps_core.mixtures.splat_reader import NEEDED, read_splats
from garps_core.mixtures.splat_writer import SH_CONSTANT, write_splats
from garps_core.types import Mixture, View

plyfile = pytest.importorskip("plyfile")


def table(n: int = 60, kind: str = "<f4", extra: tuple[tuple[str, str], ...] = (), seed: int = 0) -> np.ndarray:
    """Rows as a splat program writes them, in an order of its own."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(n, [(name, kind) for name in reversed(NEEDED)] + list(extra))
    for name in NEEDED:
        rows[name] = rng.normal(size=n)
    rows["z"] = rng.uniform(1, 5, n)
    for axis in range(3):
        rows[f"scale_{axis}"] = rng.uniform(-6, -2, n)
    return rows


def written(
    path: Path, rows: np.ndarray, *others: tuple[str, np.ndarray], byte_order: str = "<", text: bool = False
) -> Path:
    elements = [plyfile.PlyElement.describe(rows, "vertex")]
    elements += [plyfile.PlyElement.describe(array, name) for name, array in others]
    plyfile.PlyData(elements, byte_order=byte_order, text=text).write(str(path))
    return path


def column(name: str, kind: str, *numbers: float) -> tuple[str, np.ndarray]:
    return name, np.array([(number,) for number in numbers], [(name, kind)])


def sizes(covariances: np.ndarray) -> np.ndarray:
    return np.linalg.norm(covariances, axis=(1, 2))


def test_what_we_write_comes_back(tmp_path: Path) -> None:
    mixture = random_mixture(500)
    given_opacities = np.random.default_rng(3).uniform(0.01, 0.99, 500)
    again = read_splats(write_splats(mixture, tmp_path / "a.ply", given_opacities), weighting="equal")
    np.testing.assert_allclose(again.means, mixture.means, atol=1e-6)
    np.testing.assert_allclose(again.colours, mixture.colours, atol=1e-6)
    np.testing.assert_allclose(again.weights, given_opacities, atol=1e-6)
    assert (sizes(again.covariances - mixture.covariances) / sizes(mixture.covariances)).max() < 1e-4
    assert again.frustum is None and again.labels is None


def test_a_foreign_file_is_read_by_its_names(tmp_path: Path) -> None:
    """Doubles, another order, normals, higher harmonics, bytes in between."""
    extra = (("nx", "<f4"), ("f_rest_0", "<f4"), ("red", "u1"), ("flags", "<i2"))
    rows = table(kind="<f8", extra=extra)
    rows["red"] = 200
    mixture = read_splats(written(tmp_path / "a.ply", rows))
    np.testing.assert_allclose(mixture.means, np.stack([rows[a] for a in "xyz"], 1), rtol=1e-6)
    colours = np.stack([rows[f"f_dc_{i}"] for i in range(3)], 1) * SH_CONSTANT + 0.5
    np.testing.assert_allclose(mixture.colours, colours.clip(0, 1), atol=1e-6)
    sigmas = np.exp(np.sort(np.stack([rows[f"scale_{i}"] for i in range(3)], 1), axis=1))
    np.testing.assert_allclose(np.linalg.eigvalsh(mixture.covariances.astype(float)), sigmas**2, rtol=1e-3, atol=1e-9)
    opacities = 1 / (1 + np.exp(-rows["opacity"]))
    np.testing.assert_allclose(mixture.weights, opacities * sigmas[:, 1] * sigmas[:, 2], rtol=1e-5)


def test_the_quaternion_is_w_first_and_of_any_length(tmp_path: Path) -> None:
    rows = table(1)
    for name, value in zip(("rot_0", "rot_1", "rot_2", "rot_3"), (0.8, 0.2, -0.4, 0.4), strict=True):
        rows[name] = 3 * value
    for axis, sigma in enumerate((0.01, 0.02, 0.03)):
        rows[f"scale_{axis}"] = np.log(sigma)
    expected = [[4.7632, 1.0176, -2.304], [1.0176, 5.3568, -3.072], [-2.304, -3.072, 3.88]]
    np.testing.assert_allclose(1e4 * read_splats(written(tmp_path / "a.ply", rows)).covariances[0], expected, atol=1e-4)


def test_weights_are_again_the_area_seen(tmp_path: Path) -> None:
    """A slanted floor, lifted from depth, written and read."""
    v = np.arange(120)[:, None] * np.ones(160)
    view = View(
        np.full((120, 160, 3), 90, np.uint8),
        np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]]),
        (1 / (0.2 + 0.004 * v)).astype(np.float32),
    )
    exact = {"lifting.noise_floor_m": 0.0, "lifting.noise_linear": 0.0}
    mixture = reconstruct(view, Config().replace(exact))
    again = read_splats(write_splats(mixture, tmp_path / "a.ply"))
    ratio = again.weights / mixture.weights
    assert np.ptp(mixture.weights) > 2 * mixture.weights.min()
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.02)


def test_faint_components_can_be_left_out(tmp_path: Path) -> None:
    rows = table()
    path = written(tmp_path / "a.ply", rows)
    kept = 1 / (1 + np.exp(-rows["opacity"].astype(float))) >= 0.6
    assert 5 < kept.sum() < 55
    mixture = read_splats(path, min_opacity=0.6)
    np.testing.assert_array_equal(mixture.means[:, 0], rows["x"][kept])
    with pytest.raises(InputError, match="expected a lower one"):
        read_splats(path, min_opacity=1.0)
    with pytest.raises(InputError, match="min_opacity is 2"):
        read_splats(path, min_opacity=2)


def test_flat_needles_and_points_become_definite(tmp_path: Path) -> None:
    rows = table(300)
    rows["scale_0"], rows["scale_1"][:100], rows["scale_2"][100:200] = -30, -30, -60
    covariances = read_splats(written(tmp_path / "a.ply", rows)).covariances
    assert covariances.dtype == np.float32
    assert np.linalg.eigvalsh(covariances.astype(float)).min() > 0


def test_fully_opaque_logits_may_be_infinite(tmp_path: Path) -> None:
    rows = table(3)
    rows["opacity"] = (np.inf, -np.inf, 0)
    mixture = read_splats(written(tmp_path / "a.ply", rows), weighting="equal")
    np.testing.assert_allclose(mixture.weights, (1, 0, 0.5), atol=1e-7)


CAMERA = (
    column("extrinsic", "f4", *np.eye(4).ravel()),
    column("intrinsic", "f4", 800, 0, 480, 0, 800, 320, 0, 0, 1),
    column("image_size", "u4", 960, 640),
    column("frame", "i4", 1, 60),
    column("color_space", "u1", 1),
)


def test_a_camera_in_the_file_becomes_the_frustum(tmp_path: Path) -> None:
    rows = table(4)
    # pixel (600.5, 120.5) counted from edges: cell (200, 40) of a grid three times as coarse
    rows["x"], rows["y"], rows["z"] = (600.5 - 480) / 800 * 2, (120.5 - 320) / 800 * 2, 2.0
    rows["x"][1:] *= (1.5, 0.5, -1)
    rows["y"][1:] *= (1.5, 0.5, -1)
    rows["z"][1:] *= (1.5, 0.5, -1)
    rows["opacity"] = (3, 3, -3, 3)  # the nearest hides nothing, the last is behind the camera
    frustum = read_splats(written(tmp_path / "a.ply", rows, *CAMERA)).frustum
    assert frustum is not None and frustum.brightness is None
    assert frustum.depth.shape == (213, 320)
    assert frustum.depth[40, 200] == 2
    assert np.isfinite(frustum.depth).sum() == 1
    np.testing.assert_allclose(frustum.K, [[800 / 3, 0, 159.5], [0, 800 / 3, 320 / 3 - 0.5], [0, 0, 1]], rtol=1e-6)


def test_a_camera_that_cannot_be_used_is_said(tmp_path: Path) -> None:
    moved = column("extrinsic", "f4", *(np.eye(4) + 0.1).ravel())
    with pytest.raises(InputError, match=r"a\.ply: extrinsic is not the identity"):
        read_splats(written(tmp_path / "a.ply", table(), moved, *CAMERA[1:]))
    with pytest.raises(InputError, match="image_size"):
        read_splats(written(tmp_path / "a.ply", table(), CAMERA[1], column("image_size", "u4", 0, 640)))
    assert read_splats(written(tmp_path / "a.ply", table(), CAMERA[1])).frustum is None


def test_faces_behind_the_splats_are_passed_over(tmp_path: Path) -> None:
    faces = np.zeros(4, [("vertex_indices", "i4", (3,))])
    mixture = read_splats(written(tmp_path / "a.ply", table(), ("face", faces), *CAMERA))
    assert len(mixture) == 60 and mixture.frustum is None


@pytest.mark.parametrize("name", NEEDED)
def test_a_missing_property_is_named(tmp_path: Path, name: str) -> None:
    rows = np.zeros(5, [(n, "<f4") for n in NEEDED if n != name])
    with pytest.raises(InputError, match=f"property {name} is missing"):
        read_splats(written(tmp_path / "a.ply", rows))


@pytest.mark.parametrize("name", NEEDED)
def test_nan_is_refused_with_its_place(tmp_path: Path, name: str) -> None:
    rows = table()
    rows[name][7] = np.nan
    with pytest.raises(InputError, match=r"NaN.*7|7 is NaN"):
        read_splats(written(tmp_path / "a.ply", rows))


def test_other_kinds_of_ply_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(InputError, match="format is ascii"):
        read_splats(written(path, table(), text=True))
    with pytest.raises(InputError, match="format is binary_big_endian"):
        read_splats(written(path, table().astype(table().dtype.newbyteorder(">")), byte_order=">"))
    with pytest.raises(InputError, match="0 components"):
        read_splats(written(path, table(0)))
    whole = table()
    integer = whole.astype([(n, "<i4" if n == "x" else "<f4") for n in whole.dtype.names or ()])
    with pytest.raises(InputError, match="property x is int32"):
        read_splats(written(path, integer))
    still = table()
    for axis in range(4):
        still[f"rot_{axis}"][5] = 0
    with pytest.raises(InputError, match="component 5 has rotation 0 0 0 0"):
        read_splats(written(path, still))
    huge = table()
    huge["scale_1"][2] = 400
    with pytest.raises(InputError, match="expected logarithms"):
        read_splats(written(path, huge))
    with pytest.raises(InputError, match="cannot read"):
        read_splats(tmp_path / "none.ply")
    with pytest.raises(InputError, match="cannot read"):
        read_splats(tmp_path)


def header(*lines: str) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()


NAMED = [f"property float {name}" for name in NEEDED]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "does not begin with 'ply'"),
        (b"\x89PNG\r\n", "does not begin with 'ply'"),
        (b"ply\nformat binary_little_endian 1.0\n", "no end_header"),
        (b"ply\n" + b"comment\n" * 20_000 + b"end_header\n", "no end_header"),
        (b"ply\nelement vertex 1\nend_header\n", "format is missing"),
        (header(), "no plain element vertex"),
        (header("element vertex 1", "property list uchar int x"), "no plain element vertex"),
        (header("element vertex -1", *NAMED), "header line"),
        (header("element vertex 1" + "0" * 5000, *NAMED), "header line"),
        (header("element vertex 999999999999999999", *NAMED), "cut off"),
        (header("element vertex 1", "property quad x"), "property types"),
        (header("element vertex 1", "property float x", "property float x"), "names twice"),
        (header("property float x"), "header line"),
        (header("element vertex 2", *NAMED) + bytes(14 * 4 * 2 - 1), "cut off"),
        (header("element first 999999999999", "property double a", "element vertex 2", *NAMED) + bytes(999), "cut off"),
    ],
)
def test_damaged_files_are_refused_before_anything_is_allocated(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_splats(path)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("ply") / "a.ply", table(4), *CAMERA).read_bytes()


@given(position=st.integers(0, 900), value=st.integers(0, 255), cut=st.integers(0, 900))
def test_any_damage_ends_in_a_mixture_or_an_input_error(
    sound: bytes, tmp_path_factory: pytest.TempPathFactory, position: int, value: int, cut: int
) -> None:
    damaged = bytearray(sound)
    damaged[position % len(damaged)] = value
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    path.write_bytes(bytes(damaged[: len(damaged) - max(0, cut - 600)]))
    try:
        assert isinstance(read_splats(path), Mixture)
    except InputError as error:
        assert "damaged.ply" in str(error)
