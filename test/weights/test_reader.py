# SPDX-License-Identifier: Apache-2.0
"""Weights files: hostile and damaged ones are refused by name and without effect, sound ones are read."""

from __future__ import annotations

import argparse
import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hostile import Marks
from safetensors.torch import save_file
from torch import nn

from garps_core.errors import WeightsError
from garps_core.weights import manifest, reader, store
from garps_core.weights.reader import read_tensors

TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.bias": torch.ones(2), "n": torch.tensor(3)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty weights folder, with a place beside it."""
    place = tmp_path / "weights"
    place.mkdir()
    monkeypatch.setenv("GARPS_WEIGHTS", str(place))
    return place


class Evaluates(Marks):
    def __reduce__(self) -> tuple[object, ...]:
        return eval, (f"open({str(self.marker)!r}, 'w')",)


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def safetensors_of(path: Path, header: dict[str, object], data: bytes = b"") -> None:
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


def rezipped(path: Path, method: int, more: dict[str, bytes]) -> None:
    """Write a torch file anew by `zipfile` with entries added."""
    with zipfile.ZipFile(path) as old:
        entries = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", method) as new:
        for name, content in (entries | more).items():
            new.writestr(name, content)


def pickled_command(path: Path, marker: Path) -> None:
    torch.save({"a": torch.ones(2), "b": Marks(marker)}, path)


def pickled_eval(path: Path, marker: Path) -> None:
    torch.save({"args": argparse.Namespace(model=Evaluates(marker)), "model": TENSORS}, path)


def bare_pickle(path: Path, marker: Path) -> None:
    path.write_bytes(pickle.dumps(Marks(marker)))


def legacy_torch(path: Path, marker: Path) -> None:
    torch.save({"b": Marks(marker)}, path, _use_new_zipfile_serialization=False)


def namespace(path: Path, marker: Path) -> None:
    torch.save({"args": argparse.Namespace(model=f"eval(open({str(marker)!r}, 'w'))"), "model": TENSORS}, path)


def whole_network(path: Path, marker: Path) -> None:
    torch.save(nn.Linear(2, 2), path)


def script(path: Path, marker: Path) -> None:
    torch.jit.save(torch.jit.script(nn.Linear(2, 2)), path)


def truncated_zip(path: Path, marker: Path) -> None:
    torch.save({"a": torch.ones(1000)}, path)
    cut(path, 0.6)


def truncated_safetensors(path: Path, marker: Path) -> None:
    save_file({"a": torch.ones(1000)}, path)
    cut(path, 0.6)


def truncated_header(path: Path, marker: Path) -> None:
    save_file(TENSORS, path)
    cut(path, 0.2)


def huge_header(path: Path, marker: Path) -> None:
    with path.open("wb") as stream:  # sparse: takes no room on the disk
        stream.write(struct.pack("<Q", 2**25 + 1) + b"{")
        stream.truncate(2**26)


def overlapping(path: Path, marker: Path) -> None:
    entry = {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}
    safetensors_of(path, {"a": entry, "b": entry}, bytes(16))


def deep_header(path: Path, marker: Path) -> None:
    text = b'{"a":' * 200_000
    path.write_bytes(struct.pack("<Q", len(text)) + text)


def zip_bomb(path: Path, marker: Path) -> None:
    torch.save(TENSORS, path)
    rezipped(path, zipfile.ZIP_DEFLATED, {"archive/data/9": bytes(200_000_000)})


def many_entries(path: Path, marker: Path) -> None:
    torch.save(TENSORS, path)
    rezipped(path, zipfile.ZIP_STORED, {str(i): b"" for i in range(50)})


def expanded(path: Path, marker: Path) -> None:
    torch.save({"a": torch.ones(1).expand(10**12)}, path)


def repeated(path: Path, marker: Path) -> None:
    one = torch.ones(100_000)
    torch.save({f"t{i}": one for i in range(50)}, path)


def sparse(path: Path, marker: Path) -> None:
    torch.save({"a": torch.eye(3).to_sparse()}, path)


def on_meta(path: Path, marker: Path) -> None:
    torch.save({"a": torch.ones(3, device="meta")}, path)


def list_of_tensors(path: Path, marker: Path) -> None:
    torch.save([torch.ones(2)], path)


def list_among_tensors(path: Path, marker: Path) -> None:
    torch.save(TENSORS | {"more": [1, 2]}, path)


def no_tensors(path: Path, marker: Path) -> None:
    torch.save({}, path)


def link_out(path: Path, marker: Path) -> None:
    outside = path.parent.parent / "outside.pth"
    torch.save(TENSORS, outside)
    path.symlink_to(outside)


def link_in_a_circle(path: Path, marker: Path) -> None:
    path.symlink_to(path)


def folder_instead(path: Path, marker: Path) -> None:
    path.mkdir()


def fifo(path: Path, marker: Path) -> None:
    os.mkfifo(path)


def device(path: Path, marker: Path) -> None:
    path.symlink_to("/dev/zero")


HOSTILE: dict[Callable[[Path, Path], None], str] = {
    pickled_command: "class posix.system: expected tensors only",
    pickled_eval: "expected tensors only",
    bare_pickle: "bare pickle",
    legacy_torch: "bare pickle",
    namespace: "class argparse.Namespace",
    whole_network: "class torch.nn.modules.linear.Linear",
    script: "TorchScript",
    truncated_zip: "no sound torch file",
    truncated_safetensors: "no sound safetensors file",
    truncated_header: "header of",
    huge_header: "header of 33554433 bytes",
    overlapping: "no sound safetensors file",
    deep_header: "no sound safetensors file",
    zip_bomb: "none compressed",
    many_entries: "expected at most 40",
    expanded: "more values than data",
    repeated: "claims more data than it has",
    sparse: "expected a plain tensor",
    on_meta: "expected a plain tensor",
    list_of_tensors: "class list: expected tensors by name",
    list_among_tensors: "class list under 'more'",
    no_tensors: "holds nothing",
    link_out: "leads out of the weights folder",
    link_in_a_circle: "cannot read",
    folder_instead: "is a folder",
    fifo: "is a FIFO",
    device: "is a device",
}


@pytest.mark.parametrize("make", HOSTILE, ids=lambda make: make.__name__)
def test_a_hostile_file_is_refused_without_effect(
    make: Callable[[Path, Path], None], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "MAX_ENTRIES", 40)
    path, marker = folder / "model.pth", tmp_path / "marker"
    make(path, marker)
    with pytest.raises(WeightsError) as caught:
        read_tensors(path)
    assert HOSTILE[make] in str(caught.value)
    assert str(path) in str(caught.value)
    assert not marker.exists()


@pytest.mark.parametrize("make", [pickled_command, bare_pickle, legacy_torch])
def test_these_files_would_have_done_harm(make: Callable[[Path, Path], None], tmp_path: Path) -> None:
    """The marker really appears when such a file is opened without protection, or else nothing was tested."""
    make(tmp_path / "a.pth", tmp_path / "marker")
    if make is bare_pickle:
        pickle.loads((tmp_path / "a.pth").read_bytes())
    else:
        torch.load(tmp_path / "a.pth", weights_only=False)
    assert (tmp_path / "marker").exists()


def test_size_hash_and_record_are_checked(folder: Path) -> None:
    path = folder / "model.safetensors"
    save_file(TENSORS, path)
    size, digest = path.stat().st_size, reader.hash_of(path)
    assert read_tensors(path, max_bytes=size, sha256=digest).sha256 == digest
    with pytest.raises(WeightsError, match=f"has {size} bytes: expected at most {size - 1}"):
        read_tensors(path, max_bytes=size - 1)
    with pytest.raises(WeightsError, match="sha256"):
        read_tensors(path, sha256="0" * 64)
    store.record(folder, path.name, store.Record("1" * 64, size, "a test"))
    with pytest.raises(WeightsError, match=r"expected 1111.*checksums\.json"):
        read_tensors(path)
    store.record(folder, path.name, store.Record(digest, size, "a test"))
    assert read_tensors(path).sha256 == digest


@pytest.mark.parametrize(("bound", "expected"), [("MAX_HEADER", "a directory of over"), ("MAX_PICKLE", "an index of")])
def test_the_parts_of_a_torch_file_are_bounded(
    tmp_path: Path, bound: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save(TENSORS, tmp_path / "a.pth")
    read_tensors(tmp_path / "a.pth")
    monkeypatch.setattr(reader, bound, 50)
    with pytest.raises(WeightsError, match=expected):
        read_tensors(tmp_path / "a.pth")


def test_a_large_directory_is_seen_in_both_kinds_of_zip(tmp_path: Path) -> None:
    """Zip files of 64 bits have a second, larger end; `zipfile` believes that one."""
    plain = tmp_path / "plain.zip"
    with zipfile.ZipFile(plain, "w") as archive:
        archive.writestr("a", b"")
    size = reader._directory_bytes(plain)
    assert size == 46 + len("a")
    content, end = plain.read_bytes(), plain.read_bytes().rfind(b"PK\x05\x06")
    larger = struct.pack("<4sQHHIIQQQQ", b"PK\x06\x06", 44, 45, 45, 0, 0, 1, 1, 2**40, end - size)
    locator = struct.pack("<4sIQI", b"PK\x06\x07", 0, end, 1)
    plain.write_bytes(content[:end] + larger + locator + content[end:])
    assert reader._directory_bytes(plain) == 2**40


def test_a_file_that_changes_meanwhile_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, parsed = tmp_path / "a.safetensors", reader._parsed
    save_file(TENSORS, path)

    def disturbed(*arguments: Any) -> Any:
        os.utime(path, ns=(0, 0))
        return parsed(*arguments)

    monkeypatch.setattr(reader, "_parsed", disturbed)
    with pytest.raises(WeightsError, match="changed while it was read"):
        read_tensors(path)


def test_what_the_system_refuses_is_named(folder: Path) -> None:
    with pytest.raises(WeightsError, match=r"cannot read /proc/[0-9]+/mem"):
        read_tensors(Path("/proc/self/mem"))
    with pytest.raises(WeightsError, match=r"cannot write /proc/checksums\.json"):
        store.record(Path("/proc"), "a", store.Record("1" * 64, 1, "a test"))


@pytest.mark.parametrize("text", ["{", "[]", '{"a": 1}', '{"a": {"sha256": "xyz", "bytes": 1, "source": ""}}'])
def test_damaged_records_are_named(folder: Path, text: str) -> None:
    save_file(TENSORS, folder / "a.safetensors")
    (folder / store.CHECKSUMS).write_text(text)
    with pytest.raises(WeightsError, match=r"checksums\.json"):
        read_tensors(folder / "a.safetensors")


WRAPPED = {
    "plain": lambda t: t,
    "Flash3D": lambda t: {"model": t, "version": "2", "optimiser": {"state": {0: torch.ones(2)}}, "step": 3},
    "mmcv": lambda t: {"meta": {"epoch": 1, "config": "x = 1"}, "state_dict": t},
    "known words beside": lambda t: t | {"epoch": 3, "_metadata": {}},
}


@pytest.mark.parametrize("way", WRAPPED)
def test_torch_files_are_read_however_wrapped(tmp_path: Path, way: str) -> None:
    path = tmp_path / "any.name"
    torch.save(WRAPPED[way](TENSORS), path)
    found = read_tensors(path)
    assert list(found.tensors) == list(TENSORS)
    assert all(torch.equal(found.tensors[key], TENSORS[key]) for key in TENSORS)
    assert (way == "Flash3D") == (found.metadata == {"version": "2", "step": "3", "wrapper": "model"})


def test_a_namespace_is_read_where_it_is_known_to_be(tmp_path: Path) -> None:
    namespace(tmp_path / "mast3r.pth", tmp_path / "marker")
    assert set(read_tensors(tmp_path / "mast3r.pth", kind="mast3r").tensors) == set(TENSORS)
    assert not (tmp_path / "marker").exists()
    pickled_eval(tmp_path / "worse.pth", tmp_path / "marker")
    with pytest.raises(WeightsError, match="expected tensors only"):
        read_tensors(tmp_path / "worse.pth", kind="mast3r")
    namespace(tmp_path / "later.pth", tmp_path / "marker")
    with pytest.raises(WeightsError, match="Namespace"):  # the permission has ended
        read_tensors(tmp_path / "later.pth")


def test_safetensors_keep_their_metadata_and_links_inside_are_fine(folder: Path) -> None:
    save_file(TENSORS, folder / "a.safetensors", {"max_depth_m": "20"})
    (folder / "b").symlink_to("a.safetensors")
    assert read_tensors(folder / "b").metadata == {"max_depth_m": "20"}


def test_an_old_torch_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.save(TENSORS, tmp_path / "a.pth")
    monkeypatch.setattr(torch, "__version__", "2.5.1+cu121")
    with pytest.raises(WeightsError, match=r"2\.6"):
        read_tensors(tmp_path / "a.pth")


def test_the_table_is_consistent(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len({weights.local for weights in manifest.ALL}) == len(manifest.BY_NAME) == len(manifest.ALL)
    for weights in manifest.ALL:
        assert weights.repo or weights.url
        assert weights.needs_acceptance == (weights.licence != "Apache-2.0")
        assert (weights.kind == "depth_anything") == (weights.max_depth_m is not None)
    with pytest.raises(WeightsError, match="garps weights fetch depth-anything-v2-outdoor-small"):
        store.default("depth_anything", "outdoor")
    (folder / "depth_anything_v2_metric_vkitti_vitb.pth").touch()
    assert store.default("depth_anything").name == "depth-anything-v2-outdoor-base"
    monkeypatch.delenv("GARPS_WEIGHTS")
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert store.weights_folder() == Path("/data/garps/weights")
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert store.weights_folder() == Path.home() / ".local/share/garps/weights"
