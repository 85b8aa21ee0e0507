# SPDX-License-Identifier: Apache-2.0
"""Fetch a weights file from the hub, on a user's demand only. No other module of the packages uses the network."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from garps_core.errors import WeightsError
from garps_core.weights.manifest import Weights, named
from garps_core.weights.store import Record, installed, record, recorded, weights_folder
from garps_core.weights.verify import examined, verify


@dataclass(frozen=True)
class _Offer:
    """A file on the hub: commit, bytes, and its hash where the hub tells one."""

    commit: str
    size: int
    sha256: str | None


def fetch(name: str, accepted: str | None = None, say: Callable[[str], None] = print) -> Path:
    """Put a file into the weights folder, whole and checked, or not at all.

    The hub is `$HF_ENDPOINT`, by default the public one. A broken download continues where it stopped.

    Args:
        name: name of the weights.
        accepted: the same name again, for a licence that is not permissive.
        say: called with the licence first, then with the progress.
    Returns:
        Path of the file.
    Raises:
        WeightsError: licence not accepted, not on the hub, no connection, no room, or not the file that was expected.
    """
    weights, folder = named(name), weights_folder()
    say(f"{name}: licence {weights.licence}" + (f"; {page}" if (page := page_of(weights)) else ""))
    _check_acceptance(weights, accepted)
    if installed(name) is not None:
        say(f"already in {folder}: {verify(name)}")
        return folder / weights.local
    if weights.repo is None:
        raise WeightsError(f"{name} is not on the hub: expected it from you; {by_hand(weights)}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WeightsError(f"cannot make {folder} ({error.strerror}): expected a folder. Set GARPS_WEIGHTS") from None
    hub = _hub()
    offer = _offered(hub, weights)
    _check_size(weights, offer, folder)
    say(f"{weights.file} of {weights.repo}, {offer.size / 1e6:.1f} MB, commit {offer.commit[:12]} -> {folder}")
    return _placed(_downloaded(hub, weights, offer, folder), weights, offer, folder, say)


def by_hand(weights: Weights) -> str:
    """Instructions for a person without the hub to install the file."""
    source = weights.url or f"{weights.file} of {weights.repo}"
    put = f"put it into {weights_folder()} as {weights.local}"
    return f"download {source}, {put}, then run `garps weights verify {weights.name}`"


def page_of(weights: Weights) -> str:
    """Page on which the licence can be read, "" where there is none."""
    return f"hub repository {weights.repo}" if weights.repo else (weights.url or "")


def _check_acceptance(weights: Weights, accepted: str | None) -> None:
    if accepted is not None and accepted != weights.name:
        raise WeightsError(f"--accept-licence is {accepted!r}: expected the name of what is fetched, {weights.name}")
    if weights.needs_acceptance and accepted is None:
        raise WeightsError(
            f"the licence of {weights.name} is {weights.licence}: read it ({page_of(weights)}), and if your use is "
            f"allowed, repeat with --accept-licence {weights.name}"
        )


def _hub() -> Any:
    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")  # read when the library is imported
    try:
        import huggingface_hub
    except ImportError:
        raise WeightsError(
            "huggingface_hub is not installed: expected it for fetching. Run `pip install huggingface_hub`, or "
            "download the file on another machine, see docs/weights.md"
        ) from None
    return huggingface_hub


def _endpoint() -> str | None:
    return os.environ.get("HF_ENDPOINT", "").rstrip("/") or None


def _offered(hub: Any, weights: Weights) -> _Offer:
    try:
        found = hub.get_hf_file_metadata(hub.hf_hub_url(weights.repo, weights.file, endpoint=_endpoint()))
    except Exception as error:  # of the library, of the HTTP client below it, of the system
        raise _failed(weights, error) from None
    if not found.commit_hash or found.size is None:
        raise WeightsError(f"{_endpoint() or 'the hub'} tells no commit and size of {weights.file}: is it a hub?")
    etag = found.etag or ""
    return _Offer(found.commit_hash, found.size, etag if re.fullmatch("[0-9a-f]{64}", etag) else None)


def _check_size(weights: Weights, offer: _Offer, folder: Path) -> None:
    limit = weights.bytes if weights.bytes is not None else weights.bytes_bound
    if not 0 < offer.size <= limit:
        raise WeightsError(
            f"{weights.file} of {weights.repo} has {offer.size} bytes: expected at most {limit}; it is not what "
            "was known under this name"
        )
    free = shutil.disk_usage(folder).free
    if free < offer.size:
        raise WeightsError(
            f"{folder} has {free / 1e6:.0f} MB free: expected {offer.size / 1e6:.0f}. Make room or set GARPS_WEIGHTS"
        )


def _downloaded(hub: Any, weights: Weights, offer: _Offer, folder: Path) -> Path:
    staging = folder / f".fetch-{weights.name}"
    try:
        return Path(
            hub.hf_hub_download(
                weights.repo, weights.file, revision=offer.commit, local_dir=staging, endpoint=_endpoint()
            )
        )
    except Exception as error:
        if not any(staging.rglob("*.incomplete")):  # some versions of the library go on from that the next time
            shutil.rmtree(staging, ignore_errors=True)
        raise _failed(weights, error) from None


def _placed(path: Path, weights: Weights, offer: _Offer, folder: Path, say: Callable[[str], None]) -> Path:
    """Move a checked download to its place and record it; a wrong one is removed."""
    final = folder / weights.local
    try:
        found = examined(path, weights, folder)
        known = recorded(final, folder)
        for expected, source in ((offer.sha256, "the hub"), (known and known.sha256, "the earlier record")):
            if expected and found.sha256 != expected:
                raise WeightsError(
                    f"{weights.file} came with sha256 {found.sha256}: expected {expected} ({source}); not installed"
                )
        path.replace(final)
    finally:
        shutil.rmtree(folder / f".fetch-{weights.name}", ignore_errors=True)
    record(folder, final.name, Record(found.sha256, offer.size, f"{weights.repo}@{offer.commit}"))
    say(f"{final}: sha256 {found.sha256[:12]}... recorded")
    return final


def _failed(weights: Weights, error: Exception) -> WeightsError:
    reason = (str(error).strip().splitlines() or [""])[0]
    return WeightsError(
        f"cannot fetch {weights.file} of {weights.repo} from {_endpoint() or 'the hub'} "
        f"({type(error).__name__}: {reason}): expected a connection. Try again, or {by_hand(weights)}"
    )
