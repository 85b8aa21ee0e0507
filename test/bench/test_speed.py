# SPDX-License-Identifier: Apache-2.0
"""`bench.speed` measures what it says: real parts on small images."""

import json

import numpy as np
import pytest
import torch
import typer
from surfaces import TRUTH, look, random_pose

from bench.pairs.pair import Pair, scene_points
from bench.peers.autograd import PlainObjective
from bench.peers.methods import METHODS
from bench.report.checks import Check, Section, markdown
from bench.speed import __main__ as speed
from bench.speed import fresh
from bench.speed import pairs as speed_pairs
from bench.speed.determinism import determinism_section
from bench.speed.growth import growth_section, slopes, subset
from bench.speed.memory import memory_section
from bench.speed.pairs import CHAIN, GARPS, GARPS_PRIOR, PEERS, pairs_section
from bench.speed.parts import Inputs, interleaved, threads
from bench.speed.solver import autograd_section, contest, paper_section, plain, start_of
from bench.speed.stream import _loop, _planes, _torch_stream, exact_pairs, reference, stream_section
from garps_core import Config, Prior
from garps_core.geometry import se3_inverse
from garps_core.solver import paper


@pytest.fixture(scope="module")
def inputs():
    source, target = look(), look(se3_inverse(TRUTH))
    pair = Pair("surface", "surface", "small", source, target, TRUTH, scene_points(source))
    return Inputs("sensor", (pair,), 1)


def test_the_digest_sees_one_bit(inputs):
    def digest_of(T):
        found = contest(inputs, 1).align("second order")
        return fresh.digest(type(found)(found.status, "", T, found.covariance))

    T = TRUTH.copy()
    T[0, 3] = np.nextafter(T[0, 3], 1)
    assert digest_of(TRUTH) == digest_of(TRUTH.copy()) != digest_of(T)


def test_growth_has_finite_slopes(inputs):
    section = growth_section(inputs, (300, 1000, 3000), (5, 10))
    assert [(row["components"], row["neighbours"]) for row in section.rows] == [
        *((300, 5), (300, 10), (1000, 5), (1000, 10), (3000, 5), (3000, 10))
    ]
    assert np.isfinite([check.value for check in section.checks]).all() and len(section.checks) == 6
    assert len({row["steps"] for row in section.rows}) == 1, "all sizes do the same work"
    assert all(row[stage] > 0 for row in section.rows for stage in ("evaluate", "pairing", "align"))


def test_slopes_are_the_exponents():
    rows = [
        {"components": n, "neighbours": k, "evaluate": 1e-6 * n**1.3 * k**0.5} for n in (10, 30, 90) for k in (2, 4, 9)
    ]
    assert slopes(rows, "evaluate") == pytest.approx((1.3, 0.5))
    fixed_costs = [{"components": 1, "neighbours": k, "evaluate": 5.0} for k in (2, 4, 9)]
    assert slopes(fixed_costs + rows, "evaluate") == pytest.approx((1.3, 0.5))


def test_a_subset_is_even_and_never_smaller_than_asked(inputs):
    source = inputs.mixtures[0]
    np.testing.assert_array_equal(subset(source, len(source)).means, source.means)
    assert len(subset(source, 777)) == 777
    with pytest.raises(ValueError, match="give larger images"):
        subset(source, len(source) + 1)


def test_the_plain_objective_is_that_of_the_package(inputs):
    """Same candidate pairs, value and gradient by automatic differentiation."""
    config = Config.preset("paper").replace({"dtype": "float64"})
    held = contest(inputs, 1)
    held.configs["paper"] = config
    pairs, prior = held.paper_pairs(), Prior(random_pose(1, 0.05), np.eye(6))
    objective = plain(pairs)
    q, t = (part.requires_grad_() for part in start_of(prior, torch.float64))
    value = objective.value(q, t)
    dq, dt = torch.autograd.grad(value, (q, t))
    got, got_dq, got_dt = paper.value_and_gradient(pairs, q.detach().numpy(), t.detach().numpy())
    assert got == pytest.approx(value.item(), rel=1e-10)
    np.testing.assert_allclose(got_dq, dq, atol=1e-9 * float(dq.abs().max()))
    np.testing.assert_allclose(got_dt, dt, atol=1e-9 * float(dt.abs().max()))
    assert isinstance(objective, PlainObjective) and 0 < len(objective) <= pairs.count


def test_the_papers_solver_gets_the_same_components_and_its_own_number_of_pairs(inputs):
    section = paper_section(inputs, steps=3)
    default, published, same, _ = section.rows
    assert published["steps"] == 3 and default["steps"] > 3
    held = contest(inputs)
    x, y = held.mixtures["second order"][0], held.mixtures["paper"][0]
    assert x.means is y.means and x.covariances is y.covariances and np.ptp(y.weights) == 0 < np.ptp(x.weights)
    assert held.configs["paper"].paper == Config.preset("paper").paper
    assert len(held.paper_pairs().means) == -(-len(x) // 32)
    assert any(f"{len(held.paper_pairs().means)} rows" in note for note in section.notes)
    assert all(check.at_least for check in section.checks) and len(section.checks) == 5
    gains = [section.checks[i].value for i in (1, 3, 4)]
    assert min(gains) > 0, "three steps of Adam are no match"
    assert same["paper's log f"] > published["paper's log f"]


def test_autograd_is_extrapolated_to_the_papers_steps(inputs):
    section = autograd_section(inputs)
    plain_rows, default = section.rows[:-1], section.rows[-1]
    assert all(row["median s"] == pytest.approx(1000 * row["s a step"]) for row in plain_rows)
    fastest = min(row["median s"] for row in plain_rows)
    assert section.checks[0].value == pytest.approx(fastest / default["median s"])


def test_the_stream_reads_all_the_bytes_an_evaluation_reads(inputs):
    pairs = exact_pairs(inputs.mixtures, inputs.prior.T_target_source, 500, 7, inputs.config)
    planes = _planes(pairs)
    assert len(planes) == 10 and all(plane.shape == (7, 500) and plane.dtype == torch.float32 for plane in planes)
    expected = float(torch.stack(planes).sum(0).double().exp().sum())
    assert _torch_stream(planes) == pytest.approx(expected, rel=1e-3)
    assert reference()[0](planes) == pytest.approx(expected, rel=1e-3)
    assert _loop(*(plane.numpy().ravel() for plane in planes)) == pytest.approx(expected, rel=1e-3)
    section = stream_section(inputs, ((500, 7),))
    assert section.checks[0].value == pytest.approx(section.rows[0]["evaluate ms"] / section.rows[0]["stream ms"])


def test_fresh_processes_tell_their_memory_and_find_the_same_bits(inputs):
    memory = memory_section(inputs, components=3000, neighbours=10)
    whole, beyond, images = (check.value for check in memory.checks)
    assert 50 < beyond + 50 < whole < 1024 and images > 50
    same = determinism_section(inputs, runs=3, fresh=0)  # that fresh process was enough
    assert [check.met for check in same.checks] == [True] and same.rows[0]["runs"] == 3
    assert same.raw["this process"] == [memory.raw[0]["digest"]] * 3


def test_the_whole_pair_is_compared_with_features_and_then_gicp(inputs, monkeypatch):
    pytest.importorskip("small_gicp")
    pytest.importorskip("open3d")
    calls = dict.fromkeys(PEERS, 0)

    def counted(name, method):
        def call(*given):
            calls[name] += 1
            return method(*given)

        return call

    monkeypatch.setattr(speed_pairs, "METHODS", {name: counted(name, METHODS[name]) for name in PEERS})
    section = pairs_section(inputs)
    times = {row["method"]: row["median s"] for row in section.rows}
    assert set(times) == {GARPS, GARPS_PRIOR, *PEERS} and min(times.values()) > 0
    assert section.checks[0].value == pytest.approx(times[GARPS] / times[CHAIN])
    assert calls == dict.fromkeys(PEERS, inputs.runs + 1), "one call more than is timed: the warm-up"


def test_calls_take_turns_and_the_first_round_is_not_counted(inputs):
    seen = []
    times = interleaved({name: lambda name=name: seen.append(name) for name in "ab"}, 2, "", inputs.console)
    assert seen == list("ababab") and {name: len(values) for name, values in times.items()} == {"a": 2, "b": 2}


def test_threads_are_put_back():
    before = torch.get_num_threads()
    with threads(1):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before


def test_bars_and_verdicts_reach_the_files(tmp_path):
    checks = [Check("a", 2.0, 1.0), Check("b", 2.0, 1.0, at_least=True), Check("c", 3.0)]
    sections = {"x": Section("X", checks, [{"n": 1, "s": 0.123456}], ["a note"])}
    speed.write(tmp_path, sections, {"cpu": "one"})
    text = (tmp_path / "table.md").read_text()
    assert text == markdown(sections, {"cpu": "one"})
    for line in ("| a | 2 | <= 1 | NO |", "| b | 2 | >= 1 | yes |", "| c | 3 |  |  |", "| 1 | 0.1235 |", "- a note"):
        assert line in text
    held = json.loads((tmp_path / "run.json").read_text())
    assert [check["met"] for check in held["sections"]["x"]["checks"]] == [False, True, None]


def test_sections_are_chosen_by_name():
    assert speed.chosen("") == list(speed.SECTIONS)
    assert speed.chosen("memory, pairs") == ["pairs", "memory"]
    with pytest.raises(typer.BadParameter, match="'speeed' is no section: expected some of pairs"):
        speed.chosen("speeed")
