# SPDX-License-Identifier: Apache-2.0
"""The benchmark of networks counts what it says, and names what it does not know."""

import pytest
import torch
import typer
from torch import nn

from bench.machine.flop import counted_flop
from bench.networks import __main__ as networks
from bench.networks.__main__ import BAR_SHARE, MATRIX, Case, chosen, measured
from bench.networks.pair import STAGES, measured_pair
from garps_core.models import depth_anything
from garps_core.models.vit import Attention


def test_products_convolutions_and_attention_are_counted():
    n, width = 30, 12
    attention, convolution = Attention(width, heads=3), nn.Conv2d(4, 6, kernel_size=3, padding=1)
    tokens, picture = torch.zeros(2, n, width), torch.zeros(1, 4, 10, 8)
    with torch.inference_mode():
        found = counted_flop(lambda: (attention(tokens), convolution(picture)))
    assert found == 2 * 2 * n * 4 * width**2 + 2 * 2 * 2 * n**2 * width + 2 * 10 * 8 * 6 * 4 * 9


def test_a_line_of_the_table(monkeypatch):
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 42)
    monkeypatch.setattr(networks, "MULTIPLICATIONS", 1)
    before = torch.get_num_threads()
    try:
        row = measured(Case("depth-anything", "vits", 2, 40, 60), runs=1, threads=1)
    finally:
        torch.set_num_threads(before)
    assert (row["network"], row["images"], row["inside"]) == ("depth-anything vits", "2 of 40x60", "42x56")
    assert row["GFLOP/s"] == pytest.approx(row["GFLOP"] / row["wall s"])
    assert row["share"] == pytest.approx(row["GFLOP/s"] / row["matrices GFLOP/s"])
    assert 0 <= row["beyond imports MiB"] < row["peak MiB"]
    assert row["CPU s"] > 0
    assert MATRIX >= 1024  # smaller ones do not show what the machine can do


def test_cases_are_chosen_by_network_and_size():
    assert {case.size for case in chosen("depth-anything", "vits, vitl")} == {"vits", "vitl"}
    assert {case.bar for case in chosen("depth-anything", "vits")} == {None, BAR_SHARE}
    with pytest.raises(typer.BadParameter, match=r"no network nothing.*depth-anything"):
        chosen("nothing", "vits")
    with pytest.raises(typer.BadParameter, match=r"no size vitx.*vits"):
        chosen("", "vitx")


def test_a_line_of_the_table_of_pairs(monkeypatch):
    """The network runs, its answer is a room's depth: so the pair is found, and every stage has its time."""
    pytest.importorskip("trimesh")
    monkeypatch.setenv("GARPS_WEIGHTS", "restored afterwards")
    monkeypatch.setattr(depth_anything, "SHORT_SIDE", 140)
    before = torch.get_num_threads()
    try:
        row = measured_pair("depth_anything_v2", runs=1, threads=1)
    finally:
        torch.set_num_threads(before)
    assert row["status"] == "converged"
    assert all(row[f"{stage} s"] > 0 for stage in STAGES)
    assert 0 <= row["beyond imports MiB"] < row["peak MiB"]  # 0 where an earlier test needed more
