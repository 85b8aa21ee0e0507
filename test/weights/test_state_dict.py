# SPDX-License-Identifier: Apache-2.0
"""Tensors -> network: all or nothing, the fault named; and what a file is told by."""

import pytest
import torch
from golden_rule import keys, state
from torch import nn

from garps_core.errors import WeightsError
from garps_core.weights.state_dict import kind_of, load_strictly, recognised


def network() -> nn.Module:
    with torch.device("meta"):
        return nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))


def whole() -> dict[str, torch.Tensor]:
    made = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2)).state_dict()
    return {key: value for key, value in made.items() if not key.endswith("num_batches_tracked")}


def test_loading_copies_converts_and_fills_what_may_be_absent() -> None:
    given = whole()
    given["0.weight"] = given["0.weight"].half()
    module = network()
    load_strictly(module, given, "a test")
    assert module[0].weight.dtype == torch.float32
    assert module[0].weight.data_ptr() != given["0.weight"].data_ptr()
    given["0.bias"] += 1
    assert not torch.equal(module[0].bias, given["0.bias"])
    assert int(module[1].num_batches_tracked) == 0
    assert module.eval()(torch.ones(1, 3)).isfinite().all()
    load_strictly(module, whole(), "a test", dtype=torch.float16)
    assert module[0].weight.dtype == torch.float16


FAULTS = {
    "missing": (lambda t: t.pop("0.bias"), "1 of 7 tensors are missing, the first 0.bias"),
    "unexpected": (lambda t: t.update(x=torch.ones(1)), "1 are unexpected, the first x"),
    "misshaped": (lambda t: t.update({"0.bias": torch.ones(5)}), "0.bias: 5 float32, expected 2 float32"),
    "integers": (lambda t: t.update({"0.bias": torch.ones(2, dtype=torch.int64)}), "0.bias: 2 int64"),
    "not a number": (lambda t: t["0.weight"].fill_(float("nan")), "0.weight has 6 of 6 values that are not finite"),
    "too large": (lambda t: t.update({"0.bias": torch.full((2,), 1e200, dtype=torch.float64)}), "not finite"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_loading_names_the_fault(fault: str) -> None:
    given = whole()
    change, expected = FAULTS[fault]
    change(given)
    with pytest.raises(WeightsError) as caught:
        load_strictly(network(), given, "a test")
    assert expected in str(caught.value)
    assert "a test" in str(caught.value)


RECOGNISED = {
    ("dav2_vits_metric", "model"): ("depth_anything", "Depth Anything, official names"),
    ("flash3d", "model"): ("flash3d", "Flash3D"),
    ("dinov2_vits14_ade20k", "backbone"): ("dinov2", "a DINOv2 backbone, official names"),
    ("dinov2_vits14_ade20k", "linear"): ("ade20k_linear", "an ADE20K head"),
    ("dinov2_vits14_ade20k", "ms"): ("", "an ADE20K head"),  # as wide as the linear head of the giant
}


@pytest.mark.parametrize("file", RECOGNISED, ids="-".join)
def test_other_networks_are_recognised(file: tuple[str, str]) -> None:
    found = {key: torch.from_numpy(value) for key, value in state(*file).items()}
    kind, words = RECOGNISED[file]
    assert kind_of(found) == kind
    with pytest.raises(WeightsError, match=f"5 of 7 tensors are missing, .*the file is {words}$"):
        load_strictly(network(), found, "a test", optional="num_batches_tracked$|0.bias")


def test_more_networks_are_recognised() -> None:
    listed = keys("dav2_vits_metric_hf")
    names = [row[0] for row in next(iter(listed["files"].values()))]
    assert recognised(dict.fromkeys(names)) == "Depth Anything, transformers names"
    assert kind_of(dict.fromkeys(["dec_blocks.0.cross_attn.projq.weight", "downstream_head1.dpt.x"])) == "dust3r"
    assert recognised({"x": 1}) == "a network that is not known here"
    assert kind_of({}) == ""
