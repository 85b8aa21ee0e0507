# SPDX-License-Identifier: Apache-2.0
"""`garps weights fetch` against a hub on this machine: HTTP as the real one speaks it, with faults on demand."""

import hashlib
import json
import os
import re
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch
from hostile import Marks

from garps_core.cli import command
from garps_core.errors import WeightsError
from garps_core.weights import store
from garps_core.weights.fetch import fetch
from garps_core.weights.verify import verify

pytest.importorskip("huggingface_hub")

NAME = "depth-anything-v2-indoor-small"
REPO = "depth-anything/Depth-Anything-V2-Metric-Hypersim-Small"
FILE = "depth_anything_v2_metric_hypersim_vits.pth"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
CHUNK = 10 * 2**20  # the library writes so much at a time; less than that is lost when a connection breaks


class Hub(ThreadingHTTPServer):
    """Offers files by "repo/file"; notes every request; breaks the first `breaks` downloads after `after` bytes."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.seen: list[tuple[str, str, str | None]] = []
        self.breaks, self.after = 0, 0
        self.etag: str | None = None
        self.claimed_size: int | None = None

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def do_HEAD(self) -> None:
        self.answer(with_body=False)

    def do_GET(self) -> None:
        self.answer(with_body=True)

    def answer(self, with_body: bool) -> None:
        self.server.seen.append((self.command, self.path, self.headers.get("Range")))
        found = re.fullmatch(rf"/([\w.-]+/[\w.-]+)/resolve/(?:main|{COMMIT})/(.+)", self.path)
        content = self.server.files.get(f"{found[1]}/{found[2]}") if found else None
        if content is None:
            self.send_response(404)
            self.send_header("X-Error-Code", "EntryNotFound")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        begin = int(re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", "bytes=0-"))[1])
        self.send_response(206 if begin else 200)
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("ETag", f'"{self.server.etag or hashlib.sha256(content).hexdigest()}"')
        self.send_header("Content-Length", str(self.server.claimed_size or len(content) - begin))
        if begin:
            self.send_header("Content-Range", f"bytes {begin}-{len(content) - 1}/{len(content)}")
        self.end_headers()
        if with_body:
            self.send_body(content[begin:])

    def send_body(self, content: bytes) -> None:
        if self.server.breaks:
            self.server.breaks -= 1
            self.wfile.write(content[: self.server.after])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True
        else:
            self.wfile.write(content)

    def log_message(self, *_: object) -> None: ...


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A hub that offers the small network's file, and an empty weights folder."""
    server = Hub()
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("HF_ENDPOINT", server.address)
    monkeypatch.setenv("GARPS_WEIGHTS", str(tmp_path / "weights"))
    server.files[f"{REPO}/{FILE}"] = saved(tmp_path, depth_anything(1000))
    yield server
    server.shutdown()
    server.server_close()


def depth_anything(values: int) -> dict[str, torch.Tensor]:
    """Tensors that are recognised as Depth Anything's."""
    return {"pretrained.blocks.0.norm1.weight": torch.rand(values), "depth_head.projects.0.bias": torch.ones(2)}


def saved(folder: Path, content: object) -> bytes:
    torch.save(content, folder / "made.pth")
    return (folder / "made.pth").read_bytes()


def folder_of(tmp_path: Path) -> list[str]:
    place = tmp_path / "weights"
    return sorted(path.name for path in place.rglob("*")) if place.exists() else []


def test_a_file_is_fetched_whole_recorded_and_checked_from_then_on(hub: Hub, tmp_path: Path) -> None:
    said: list[str] = []
    path = fetch(NAME, say=said.append)
    assert path == tmp_path / "weights" / FILE
    assert path.read_bytes() == hub.files[f"{REPO}/{FILE}"]
    assert folder_of(tmp_path) == ["checksums.json", FILE]
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    entry = json.loads((path.parent / store.CHECKSUMS).read_text())[FILE]
    assert entry == {"sha256": digest, "bytes": path.stat().st_size, "source": f"{REPO}@{COMMIT}"}
    assert "Apache-2.0" in said[0]
    assert {seen[:2] for seen in hub.seen} == {
        ("HEAD", f"/{REPO}/resolve/main/{FILE}"),
        ("HEAD", f"/{REPO}/resolve/{COMMIT}/{FILE}"),
        ("GET", f"/{REPO}/resolve/{COMMIT}/{FILE}"),
    }
    asked = len(hub.seen)
    assert fetch(NAME, say=said.append) == path
    assert len(hub.seen) == asked, "what is there is not asked for again"
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(WeightsError, match="sha256"):
        verify(NAME)


def test_a_broken_connection_is_taken_up_where_it_broke(hub: Hub, tmp_path: Path) -> None:
    content = saved(tmp_path, depth_anything(6_000_000))
    hub.files[f"{REPO}/{FILE}"], hub.breaks, hub.after = content, 1, CHUNK + 5000
    assert fetch(NAME).read_bytes() == content
    ranges = [seen[2] for seen in hub.seen if seen[0] == "GET"]
    assert ranges == [None, f"bytes={CHUNK}-"]


@pytest.mark.parametrize("accepted", [None, "mast3r"])
def test_nothing_is_asked_before_the_licence_is_accepted(hub: Hub, tmp_path: Path, accepted: str | None) -> None:
    said: list[str] = []
    with pytest.raises(WeightsError, match="accept-licence"):
        fetch("flash3d", accepted, said.append)
    assert "none stated" in said[0]
    assert hub.seen == []
    assert folder_of(tmp_path) == []


def test_an_accepted_licence_is_fetched(hub: Hub, tmp_path: Path) -> None:
    tensors = {
        "models.x.encoder.encoder.conv1.weight": torch.ones(2),
        "models.x.models.gauss_decoder_0.y": torch.ones(2),
    }
    hub.files["einsafutdinov/flash3d/model_re10k_v2.pth"] = saved(tmp_path, {"model": tensors})
    assert fetch("flash3d", "flash3d").name == "model_re10k_v2.pth"


def other_network(hub: Hub, tmp_path: Path) -> None:
    hub.files[f"{REPO}/{FILE}"] = saved(tmp_path, {"x": torch.ones(2)})


def pickled_command(hub: Hub, tmp_path: Path) -> None:
    hub.files[f"{REPO}/{FILE}"] = saved(tmp_path, depth_anything(5) | {"x": Marks(tmp_path / "marker")})


def other_hash(hub: Hub, tmp_path: Path) -> None:
    hub.etag = "a" * 64


def changed_since(hub: Hub, tmp_path: Path) -> None:
    (tmp_path / "weights").mkdir()
    store.record(tmp_path / "weights", FILE, store.Record("b" * 64, 3, "earlier"))


def too_large(hub: Hub, tmp_path: Path) -> None:
    hub.claimed_size = 10**12


def not_there(hub: Hub, tmp_path: Path) -> None:
    hub.files.clear()


def no_hub(hub: Hub, tmp_path: Path) -> None:
    os.environ["HF_ENDPOINT"] = "http://127.0.0.1:9"  # set by the fixture, which restores it


def breaks_for_ever(hub: Hub, tmp_path: Path) -> None:
    hub.breaks = 99


FAULTS = {
    other_network: "holds a network that is not known here: expected depth_anything",
    pickled_command: "class posix.system",
    other_hash: "expected aaaa",
    changed_since: r"expected bbbb.*the earlier record",
    too_large: "has 1000000000000 bytes: expected at most 110000000",
    not_there: "cannot fetch .*404",
    breaks_for_ever: "cannot fetch .*expected a connection",
    no_hub: "cannot fetch .*127.0.0.1:9 .*garps weights verify",
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_what_is_wrong_is_not_installed(hub: Hub, tmp_path: Path, fault: object) -> None:
    fault(hub, tmp_path)
    with pytest.raises(WeightsError, match=FAULTS[fault]):
        fetch(NAME)
    assert set(folder_of(tmp_path)) <= {"checksums.json"}
    assert not (tmp_path / "marker").exists()
    if fault is too_large:
        assert all(seen[0] == "HEAD" for seen in hub.seen)


def test_what_no_hub_has_is_left_to_the_person(hub: Hub) -> None:
    with pytest.raises(WeightsError, match=r"download https://.*ade20k_linear_head\.pth.*garps weights verify"):
        fetch("dinov2-small-ade20k-linear")
    assert hub.seen == []


def test_without_the_library_the_command_that_installs_it_is_named(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(WeightsError, match="pip install huggingface_hub"):
        fetch(NAME)
    assert hub.seen == []


def test_the_command_shows_progress_and_asks_for_nothing_else(hub: Hub, tmp_path: Path) -> None:
    environment = os.environ | {"HOME": str(tmp_path), "HF_HOME": str(tmp_path / "hf")}
    words = [sys.executable, "-m", "garps_core.cli", "weights", "fetch", NAME]
    screen, terminal = os.openpty()  # elsewhere no bar is drawn
    termios.tcsetwinsize(screen, (24, 100))
    done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, stderr=terminal, text=True, timeout=120)
    os.close(terminal)
    with os.fdopen(screen, "rb", buffering=0) as drawn:
        shown = drawn.read(100_000)
    assert done.returncode == 0, shown
    assert done.stdout.startswith(f"{NAME}: licence Apache-2.0")
    assert b"100%" in shown
    assert folder_of(tmp_path) == ["checksums.json", FILE]
    assert all(f"/{REPO}/resolve/" in seen[1] for seen in hub.seen)


def test_the_command_refuses_with_one_line(hub: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["weights", "fetch", "mast3r"]) == 2
    captured = capsys.readouterr()
    assert captured.out.startswith("mast3r: licence CC BY-NC-SA 4.0")
    assert captured.err.count("\n") == 1
    assert "--accept-licence mast3r" in captured.err
    assert hub.seen == []


def test_the_suite_cannot_leave_this_machine() -> None:
    with socket.socket() as outward, pytest.raises(PermissionError, match=r"192\.0\.2\.1"):
        outward.connect(("192.0.2.1", 80))
    with pytest.raises(PermissionError):
        socket.create_connection(("192.0.2.1", 80), timeout=1)
