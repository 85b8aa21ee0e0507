# SPDX-License-Identifier: Apache-2.0
"""Whole pairs with networks: `garps align` by Flash3D, labels on both kinds of mixture; and pairs of splat files."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from box_room import K_WORDS, START, TRUTH
from network_weights import GOLDEN, install, pair, passes, shared, write_pair
from small_mask2former import ADAPTER, HEAD, random_state

from garps_core import Config, Prior, align_mixtures, metrics
from garps_core.cli import command
from garps_core.geometry import se3_exp
from garps_core.mixtures.flash3d import labels_of, predict_gaussians
from garps_core.mixtures.reconstruct import mixture_of, mixtures_of, reconstruct, with_depth
from garps_core.mixtures.splat_writer import write_splats
from garps_core.models import depth_anything
from garps_core.models.depth_anything import DepthAnythingV2
from garps_core.models.flash3d import PADDED, Flash3D
from garps_core.models.mask2former import Mask2Former
from garps_core.models.semantics import segment

MONOCULAR = Config.preset("monocular")
FLASH3D = MONOCULAR.replace({"reconstruction.method": "flash3d"})
Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("weights"), *GOLDEN)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return write_pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(autouse=True)
def installed(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All networks are there, and that of depth looks at small pictures."""
    monkeypatch.setenv("GARPS_WEIGHTS", str(weights))
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 70)


def labelling(head: str, backbone: str = "") -> Config:
    return Config().replace({"reconstruction.semantics": head, "reconstruction.semantic_backbone": backbone})


def test_two_pictures_by_flash3d(files: dict[str, str], tmp_path: Path, capsys: Captured) -> None:
    """The parameters are pseudo-random: there is an answer, it says that it is none, and each network ran once."""
    extras = ["--json", "--figure", str(tmp_path / "pair.png"), "--ply", str(tmp_path / "splats")]
    with passes(DepthAnythingV2) as of_depth, passes(Flash3D) as of_gaussians:
        code = command.main(["align", files["a"], files["b"], *K_WORDS, "--reconstruction", "flash3d", *extras])
    assert code == 1
    assert of_depth == [(2, 3, 70, 98)]
    assert of_gaussians == [(1, 3, *PADDED)] * 2
    out = json.loads(capsys.readouterr().out)
    assert (out["ok"], out["status"]) == (False, "poor_fit")
    assert 0 <= out["quality"] < 0.1
    assert set(out["seconds"]) == {"depth", "reconstruct", "initialise", "align"}
    T, covariance = np.array(out["T_target_source"]), np.array(out["covariance"])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    assert T.shape == (4, 4) and np.linalg.eigvalsh(covariance).min() > 0
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert {path.name for path in (tmp_path / "splats").iterdir()} == {"source.ply", "target.ply", "aligned.ply"}


def test_two_pictures_by_the_depth_network_alone(files: dict[str, str], capsys: Captured) -> None:
    """Without depth files the preset is monocular, and nothing else has to be said."""
    with passes(DepthAnythingV2) as of_depth, passes(Flash3D) as of_gaussians:
        assert command.main(["align", files["a"], files["b"], *K_WORDS, "--json"]) in (0, 1)
    assert (of_depth, of_gaussians) == ([(2, 3, 70, 98)], [])
    out = json.loads(capsys.readouterr().out)
    assert out["quality"] < 0.1, "depth that means nothing"
    assert out["seconds"]["depth"] > 0


def test_flash3d_stands_on_a_sensors_depth(files: dict[str, str], capsys: Captured) -> None:
    """The pose is near the truth even with pseudo-random offsets around the depth."""
    depths = ["--depth-source", files["a_mm"], "--depth-target", files["b_mm"]]
    with passes(DepthAnythingV2) as of_depth:
        command.main(["align", files["a"], files["b"], *K_WORDS, *depths, "--reconstruction", "flash3d", "--json"])
    assert of_depth == []
    T = np.array(json.loads(capsys.readouterr().out)["T_target_source"])
    assert metrics.translation_error_m(T, TRUTH) < 0.05
    assert metrics.rotation_error_deg(T, TRUTH) < 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--depth-source"], "the preset monocular, whose depth comes from a network"),
        (["--preset", "sensor"], "the preset monocular, whose depth comes from a network"),
        (["--preset", "sensor", "--reconstruction", "flash3d"], "whose depth is off by per cents"),
        (["--reconstruction", "ply"], "expected two images, or two splat files"),
        (["--set", "reconstruction.method=ply"], "garps align a.ply b.ply"),
        (["--reconstruction", "dust3r"], "'dust3r': expected one of"),
        (["--set", "reconstruction.scene=outdoor"], "garps weights fetch depth-anything-v2-outdoor-small"),
    ],
)
def test_mistakes_are_one_line(files: dict[str, str], words: list[str], message: str, capsys: Captured) -> None:
    given = [*words, files["a_mm"]] if words == ["--depth-source"] else words
    assert command.main(["align", files["a"], files["b"], *K_WORDS, *given]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""


@pytest.mark.parametrize("head", ["linear", "ms"])
def test_a_lifted_component_has_the_label_of_its_pixel(head: str) -> None:
    (view,) = pair(depth=True)[:1]
    mixture = reconstruct(view, labelling(head), shared())
    labels = segment(shared().segmenter(labelling(head)), view.rgb)
    assert len(np.unique(labels)) > 1 and labels.shape == view.rgb.shape[:2]
    pixels = mixture.means[:, :2] / mixture.means[:, 2:] * (view.K[0, 0], view.K[1, 1]) + view.K[:2, 2]
    column, row = np.rint(pixels).astype(int).T
    np.testing.assert_array_equal(mixture.labels, labels[row, column])
    assert reconstruct(view, Config()).labels is None


def test_both_gaussians_of_a_pixel_have_its_label() -> None:
    """Components come in the order of the published solver, which tells them by their place in the list."""
    changes = {"reconstruction.method": "flash3d", "reconstruction.semantics": "linear", "lifting.max_range_m": 1000.0}
    config = Config.preset("paper").replace(changes)
    (view,) = with_depth(pair()[:1], config, shared())
    mixture = mixture_of(view, config, shared())
    gaussians = predict_gaussians(shared().flash3d(config), view)
    kept = (gaussians.means[:, 2] >= config.lifting.min_range_m) & (gaussians.opacities >= 1 / 255)
    np.testing.assert_array_equal(mixture.means, gaussians.means[kept])
    pixel = gaussians.index[kept] % (PADDED[0] * PADDED[1])
    expected = labels_of(segment(shared().segmenter(config), view.rgb), view, pixel)
    np.testing.assert_array_equal(mixture.labels, expected)
    of_pixel = np.full(PADDED[0] * PADDED[1], -1)
    of_pixel[pixel] = mixture.labels
    np.testing.assert_array_equal(of_pixel[pixel], mixture.labels)
    assert len(pixel) > len(np.unique(pixel)) and len(np.unique(mixture.labels)) > 1


@pytest.mark.parametrize("method", ["rgbd", "flash3d"])
def test_different_labels_count_for_less_where_there_are_labels(method: str) -> None:
    start, found = Prior(TRUTH, 1e-4 * np.eye(6)), {}
    for semantics in ("none", "ms"):
        config = Config().replace({"reconstruction.method": method, "reconstruction.semantics": semantics})
        x, y = mixtures_of(pair(depth=True), config, shared())
        for discount in (1.0, 0.1):
            changed = config.replace({"alignment.semantic_discount": discount})
            found[semantics, discount] = align_mixtures(x, y, start, changed).objective
    assert found["none", 1.0] == found["none", 0.1] == pytest.approx(found["ms", 1.0], rel=1e-6)
    assert abs(found["ms", 0.1] - found["ms", 1.0]) > 1e-4


def test_heads_take_the_backbone_that_is_there(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The backbone has two names, and may be a file."""
    for name in ("dinov2_vits14_ade20k_linear_head.pth", "dinov2-small-hf.safetensors"):
        (tmp_path / name).write_bytes(
            (weights / name.replace("-small-hf.safetensors", "_vits14_pretrain.pth")).read_bytes()
        )
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path))
    assert shared().segmenter(labelling("linear")).taps == (11,)
    file = str(weights / "dinov2_vits14_pretrain.pth")
    assert shared().segmenter(labelling("linear", file)).taps == (11,)


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], np.ndarray]:
    """A generated room seen by two cameras, as splat files; and the true pose."""
    pytest.importorskip("trimesh")
    from bench.rooms import make_pair
    from garps_core import View

    folder, seen = tmp_path_factory.mktemp("splats"), make_pair(3, level=2, width=320, height=240, depth_noise="sensor")
    views = View(seen.rgb0, seen.K0, seen.depth0), View(seen.rgb1, seen.K1, seen.depth1)
    paths = [folder / f"{name}.ply" for name in "ab"]
    for view, path in zip(views, paths, strict=True):
        write_splats(reconstruct(view), path)
    return [str(path) for path in paths], seen.T_1_0


def test_two_splat_files_give_the_true_pose(splats: tuple[list[str], np.ndarray], capsys: Captured) -> None:
    from garps_core.cli.report import as_json
    from garps_core.types import PoseEstimate, Status

    paths, truth = splats
    off = se3_exp(np.array([0.05, -0.04, 0.03, 0.02, -0.03, 0.02])) @ truth
    told = as_json(PoseEstimate(Status.CONVERGED, "", off, np.eye(6)))
    prior = " ".join(map(str, (*told["translation_m"], *told["quaternion_xyzw"])))
    code = command.main(["align", *paths, "--prior", prior, "--json"])
    out = json.loads(capsys.readouterr().out)
    assert code == 0, out["reason"]
    T = np.array(out["T_target_source"])
    assert metrics.translation_error_m(off, truth) > 0.05 > 0.01 > metrics.translation_error_m(T, truth)
    assert metrics.rotation_error_deg(T, truth) < 0.5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (lambda splats, image: [splats[0], image], "expected two images, or two splat files"),
        (lambda splats, image: [image, splats[1], *K_WORDS], "expected two images, or two splat files"),
        (lambda splats, image: [*splats, "--reconstruction", "rgbd"], "with --reconstruction rgbd"),
        (lambda splats, image: [*splats, *K_WORDS], "expected none, nothing is to be reconstructed"),
        (lambda splats, image: [*splats, "--depth-source", image], "expected none, nothing is to be reconstructed"),
        (lambda splats, image: [*splats, "--set", "reconstruction.semantics=ms"], "nothing is to be reconstructed"),
        (lambda splats, image: [*splats, "--set", "reconstruction.method=rgbd"], "nothing is to be reconstructed"),
        (lambda splats, image: [splats[0], "none.ply"], "cannot read none.ply"),
    ],
)
def test_splats_and_pictures_do_not_mix(
    splats: tuple[list[str], np.ndarray], files: dict[str, str], words, message: str, capsys: Captured
) -> None:
    assert command.main(["align", *words(splats[0], files["a"]), "--prior", START]) == 2
    assert message in capsys.readouterr().err


def test_the_published_pipeline_is_one_command(files: dict[str, str], tmp_path: Path, capsys: Captured) -> None:
    """It is run up to its mixtures, with a reduced Mask2Former, since the published one has gigabytes."""
    published = ["--preset", "paper", "--reconstruction", "flash3d", "--set", "reconstruction.semantics=m2f"]
    assert command.main(["align", files["a"], files["b"], *K_WORDS, *published]) == 2
    assert "download it from https://dl.fbaipublicfiles.com/dinov2/dinov2_vitg14/" in capsys.readouterr().err
    torch.save(random_state(Mask2Former(ADAPTER, HEAD)), tmp_path / "m2f.pth")
    changes = {"method": "flash3d", "semantics": "m2f", "semantic_weights": str(tmp_path / "m2f.pth")}
    config = Config.preset("paper").replace({f"reconstruction.{name}": value for name, value in changes.items()})
    mixture = mixture_of(with_depth(pair()[:1], config)[0], config)
    assert mixture.labels is not None and set(np.unique(mixture.labels)) <= set(range(HEAD.classes))
