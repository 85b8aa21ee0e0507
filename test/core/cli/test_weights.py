# SPDX-License-Identifier: Apache-2.0
"""`garps weights` list, verify, convert and check, on files of the real networks' names and shapes, filled by rule."""

from pathlib import Path

import numpy as np
import pytest
import torch
from golden_rule import keys, state
from safetensors.torch import save_file

from garps_core.cli import command
from garps_core.errors import WeightsError
from garps_core.models.check import drawn_room
from garps_core.models.convert import needed
from garps_core.models.mask2former import HeadSize, Mask2Former
from garps_core.models.vit_adapter import AdapterSize
from garps_core.weights.reader import hash_of, read_tensors

DEPTH = "depth_anything_v2_metric_hypersim_vits.pth"
Printed = pytest.CaptureFixture[str]
Tensors = dict[str, torch.Tensor]


def tensors_of(name: str, file: str | None = None) -> Tensors:
    return {key: torch.from_numpy(value) for key, value in state(name, file).items()}


@pytest.fixture(scope="module")
def depth() -> Tensors:
    return tensors_of("dav2_vits_metric")


@pytest.fixture(scope="module")
def flash3d() -> Tensors:
    """Tensors as in the real file, with a part that is never read."""
    other = {"models.unidepth_extended.unidepth.pixel_encoder.cls_token": torch.ones(3)}
    return tensors_of("flash3d") | other | {"backproject_depth.0.ones": torch.ones(1)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "weights"
    place.mkdir()
    monkeypatch.setenv("GARPS_WEIGHTS", str(place))
    return place


def weights(*words: object) -> int:
    return command.main(["weights", *map(str, words)])


def refused(capsys: Printed, *words: object) -> str:
    """The single line that a mistake prints."""
    capsys.readouterr()
    assert weights(*words) == 2
    line = capsys.readouterr().err
    assert line.startswith("garps: error: ")
    assert line.count("\n") == 1
    return line


def test_the_list_says_what_is_there(folder: Path, depth: Tensors, capsys: Printed) -> None:
    torch.save(depth, folder / DEPTH)
    assert weights("list") == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert " yes " in rows["depth-anything-v2-indoor-small"]
    assert " 99.2 " in rows["depth-anything-v2-indoor-small"]
    assert " yes " not in rows["flash3d"]
    assert "none stated *" in rows["flash3d"]
    assert "CC BY-NC-SA 4.0 *" in rows["mast3r"]
    assert "*" not in rows["dinov2-small"]
    assert str(folder) in rows["folder:"]


def test_verify_records_first_and_compares_then(folder: Path, depth: Tensors, capsys: Printed) -> None:
    assert weights("verify") == 1
    torch.save(depth, folder / DEPTH)
    assert weights("verify") == 0
    assert "recorded now" in capsys.readouterr().out
    assert weights("verify", "depth-anything-v2-indoor-small") == 0
    assert "as recorded (first verification)" in capsys.readouterr().out
    torch.save({**depth, "pretrained.cls_token": depth["pretrained.cls_token"] + 1}, folder / DEPTH)
    assert weights("verify") == 1
    out = capsys.readouterr().out
    assert "FAILED" in out
    assert "checksums.json" in out
    assert "not installed" in verify_text(capsys, "flash3d")
    assert "did you mean 'flash3d'" in verify_text(capsys, "flash3")


def verify_text(capsys: Printed, name: str) -> str:
    assert weights("verify", name) == 1
    return capsys.readouterr().out


def test_a_file_under_the_name_of_another_is_found_out(folder: Path, depth: Tensors, capsys: Printed) -> None:
    torch.save(depth, folder / "dinov2_vitb14_pretrain.pth")
    assert "holds Depth Anything, official names: expected dinov2" in verify_text(capsys, "dinov2-base")
    torch.save(depth, folder / "dinov2_vits14_pretrain.pth")
    assert "expected at most 95000000" in verify_text(capsys, "dinov2-small")


@pytest.mark.parametrize("head", ["linear", "ms"])
def test_heads_are_verified_though_their_width_may_be_ambiguous(folder: Path, head: str, capsys: Printed) -> None:
    found = tensors_of("dinov2_vits14_ade20k", head)
    torch.save({"meta": {}, "state_dict": found}, folder / f"dinov2_vits14_ade20k_{head}_head.pth")
    assert weights("verify", f"dinov2-small-ade20k-{head}") == 0
    assert weights("check", folder / f"dinov2_vits14_ade20k_{head}_head.pth") == 0
    assert "150 classes" in capsys.readouterr().out
    del found["decode_head.bn.bias"]
    torch.save(found, folder / "other.pth")
    assert "the first bn.bias" in refused(capsys, "check", folder / "other.pth")


def test_converting_flash3d_keeps_what_is_needed(
    folder: Path, tmp_path: Path, flash3d: Tensors, capsys: Printed
) -> None:
    source, target = folder / "model_re10k_v2.pth", tmp_path / "flash3d.safetensors"
    torch.save({"model": flash3d, "version": "2", "optimiser": {"state": {}}, "step": 7}, source)
    assert weights("convert", source, target) == 0
    out = capsys.readouterr().out
    assert "1 tensors of models.unidepth_extended.unidepth" in out
    assert "none stated" in out
    found = read_tensors(target)
    assert len(found.tensors) == 385
    assert target.stat().st_size < 203e6
    assert found.metadata["source_sha256"] == hash_of(source)
    assert found.metadata["kind"] == "flash3d"
    some = "models.gauss_decoder_1.out.weight"
    assert torch.equal(found.tensors[some], flash3d[f"models.unidepth_extended.{some}"])
    assert weights("check", target) == 0
    assert "not read: none" in capsys.readouterr().out


def test_converting_depth_anything_asks_for_what_no_file_tells(
    folder: Path, tmp_path: Path, depth: Tensors, capsys: Printed
) -> None:
    source, renamed, target = folder / DEPTH, tmp_path / "mine.pth", tmp_path / "depth.safetensors"
    torch.save(depth, source)
    torch.save({"model": depth}, renamed)
    assert "indoor (Hypersim, 20 m) or outdoor" in refused(capsys, "convert", source, target)
    assert "relative model" in refused(capsys, "convert", source, target)
    assert "expected --variant indoor" in refused(capsys, "convert", source, target, "--variant", "outdoor")
    assert not target.exists()
    assert weights("convert", renamed, target, "--variant", "outdoor") == 0
    metadata = read_tensors(target).metadata
    assert (metadata["max_depth_m"], metadata["size"], metadata["licence"]) == ("80", "vits", "Apache-2.0")
    assert metadata["source"] == "mine.pth"
    assert "exists" in refused(capsys, "convert", renamed, target, "--variant", "outdoor")
    assert ".safetensors" in refused(capsys, "convert", renamed, tmp_path / "a.pth", "--variant", "outdoor")
    assert "cannot write" in refused(capsys, "convert", renamed, "/proc/a.safetensors", "--variant", "outdoor")
    assert "expected outdoor" in refused(capsys, "check", target, "--variant", "indoor")


def test_aliases_of_mast3r_files_are_taken_away() -> None:
    head = "downstream_head1.dpt.scratch."
    values = {f"{head}layer{i}_rn.weight": torch.full((2,), float(i)) for i in (1, 2, 3, 4)}
    aliases = {f"{head}layer_rn.{i - 1}.weight": torch.full((2,), float(i)) for i in (1, 2, 3, 4)}
    kept, left = needed("mast3r", values | aliases)
    assert list(kept) == list(values)
    assert left == {f"{head}layer_rn": 4}
    with pytest.raises(WeightsError, match=r"layer_rn\.0\.weight differs"):
        needed("mast3r", values | {f"{head}layer_rn.0.weight": torch.zeros(2)})
    kept, left = needed("mast3r", aliases)
    assert {key: float(value[0]) for key, value in kept.items()} == {key: float(v[0]) for key, v in values.items()}
    assert left == {}


def test_check_tells_noise_from_a_network(folder: Path, depth: Tensors, capsys: Printed) -> None:
    """The rule's weights are noise: shapes and values are right, and the depth has nothing to do with the picture."""
    torch.save(depth, folder / DEPTH)
    assert weights("check", folder / DEPTH) == 1
    out = capsys.readouterr().out
    assert "Depth Anything V2 of width 384" in out
    assert [line.split()[0] for line in out.splitlines() if "NOT PLAUSIBLE" in line] == ["likeness"]


def test_check_knows_a_relative_model(tmp_path: Path, depth: Tensors, capsys: Printed) -> None:
    bias = "depth_head.scratch.output_conv2.2.bias"
    torch.save({**depth, bias: torch.full((1,), 60.0)}, tmp_path / "mine.pth")
    assert weights("check", tmp_path / "mine.pth", "--variant", "indoor") == 1
    assert "relative model" in capsys.readouterr().out
    assert "--variant is missing" in refused(capsys, "check", tmp_path / "mine.pth")


def broken(tensors: Tensors, what: str) -> Tensors:
    changed = dict(tensors)
    key = next(key for key in changed if key.endswith("conv1.weight"))
    if what == "missing":
        del changed[key]
    elif what == "misshaped":
        changed[key] = changed[key][:1]
    else:
        changed[key] = changed[key] * float("inf")
    return changed


@pytest.mark.parametrize("what", ["missing", "misshaped", "not finite"])
@pytest.mark.parametrize("network", ["depth", "flash3d"])
def test_check_refuses_what_does_not_fit(
    tmp_path: Path, network: str, what: str, request: pytest.FixtureRequest, capsys: Printed
) -> None:
    save_file(broken(request.getfixturevalue(network), what), tmp_path / "a.safetensors")
    variant = ["--variant", "indoor"] if network == "depth" else []
    assert "conv1.weight" in refused(capsys, "check", tmp_path / "a.safetensors", *variant)


def test_check_reads_backbones_of_both_layouts(folder: Path, tmp_path: Path, capsys: Printed) -> None:
    official = tensors_of("dinov2_vits14_ade20k", "backbone")
    torch.save(official, folder / "dinov2_vits14_pretrain.pth")
    assert weights("check", folder / "dinov2_vits14_pretrain.pth") == 0
    assert "DINOv2 vits" in capsys.readouterr().out
    listed = next(iter(keys("dav2_vits_metric_hf")["files"].values()))
    hub = {row[0].removeprefix("backbone."): torch.zeros(row[1]) for row in listed if row[0].startswith("backbone.")}
    save_file(hub, tmp_path / "model.safetensors")
    assert weights("check", tmp_path / "model.safetensors") == 0
    assert "transformers names" in capsys.readouterr().out


def test_the_drawn_room_is_seen_from_inside() -> None:
    rgb, depth = drawn_room()
    assert rgb.shape == (240, 320, 3)
    assert rgb.std() > 20
    assert depth.max() == np.float32(5)
    assert 2 < depth.min() < 3
    assert depth[-1].mean() < depth[120].mean(), "the floor in front is nearer than what is straight ahead"


def test_a_file_of_anything_else_is_named(tmp_path: Path, capsys: Printed) -> None:
    torch.save({"x": torch.ones(2)}, tmp_path / "a.pth")
    assert weights("check", tmp_path / "a.pth") == 1
    assert "a network that is not known here" in capsys.readouterr().out
    assert "not known here" in refused(capsys, "convert", tmp_path / "a.pth", tmp_path / "b.safetensors")
    assert "cannot read" in refused(capsys, "check", tmp_path / "none.pth")
    assert command.main(["weights"]) == 2
    assert "convert" in capsys.readouterr().out


def test_check_reads_a_small_mask2former(tmp_path: Path, capsys: Printed) -> None:
    network = Mask2Former(AdapterSize(64, 4, 48, 4, 4, 32, 16), HeadSize(32, 32, 4, 2, 4, 40, 56, 9, 150))
    torch.save({"meta": {"epoch": 1}, "state_dict": network.state_dict(), "optimizer": {}}, tmp_path / "a.pth")
    assert weights("check", tmp_path / "a.pth") == 0
    assert "Mask2Former on ViT-Adapter" in capsys.readouterr().out
