# SPDX-License-Identifier: Apache-2.0
"""Convert a weights file to safetensors: the needed tensors alone, with their origin in the metadata."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from garps_core.errors import WeightsError
from garps_core.weights.manifest import ALL, MAX_DEPTH_M, Weights, of_file
from garps_core.weights.reader import read_tensors, write_tensors
from garps_core.weights.state_dict import check_finite, kind_of, recognised

_SIZES = {384: "vits", 768: "vitb", 1024: "vitl", 1536: "vitg"}


@dataclass(frozen=True)
class Conversion:
    """A written file: tensors kept, its bytes, the number of tensors left out by the start of their names."""

    kept: int
    bytes: int
    left: Mapping[str, int]
    licence: str


def convert(source: Path, target: Path, *, variant: str = "", kind: str | None = None) -> Conversion:
    """Write the needed tensors of `source` to the safetensors file `target`.

    Args:
        source: torch or safetensors.
        target: `.safetensors`; must not exist.
        variant: indoor or outdoor, for Depth Anything, whose tensors do not tell it.
        kind: the network, where the file's name does not say it and reading depends on it (MASt3R, DUSt3R).
    Raises:
        WeightsError: unreadable, unknown, a missing or contradicting variant, values that are not finite.
    """
    if target.suffix != ".safetensors" or target.exists():
        state = "exists" if target.exists() else "has another ending"
        raise WeightsError(f"{target} {state}: expected a new file that ends in .safetensors")
    known = of_file(source.name)
    found = read_tensors(source, kind=kind or (known.kind if known else None))
    told = kind_of(found.tensors) or (known.kind if known else "")
    if not told:
        raise WeightsError(f"{source} holds {recognised(found.tensors)}: expected a network that GARPS knows")
    kept, left = needed(told, found.tensors)
    check_finite(kept, str(source))
    weights = _entry(source, told, kept, _checked_variant(source, told, variant, known))
    write_tensors(target, kept, {**_metadata(weights), "source": source.name, "source_sha256": found.sha256})
    return Conversion(len(kept), target.stat().st_size, left, weights.licence)


def needed(kind: str, tensors: Mapping[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
    """Return the tensors that the network has, without aliases; count the others by the start of their names."""
    if kind == "flash3d":
        from garps_core.models.flash3d import flash3d_tensors

        return flash3d_tensors(tensors)
    if kind in ("mast3r", "dust3r"):
        from garps_core.models.two_view_heads import without_aliases

        return without_aliases(tensors)
    return dict(tensors), {}


def _checked_variant(source: Path, kind: str, variant: str, known: Weights | None) -> str:
    if kind != "depth_anything":
        if variant:
            raise WeightsError(f"--variant {variant} is for Depth Anything: expected none for {kind}")
        return ""
    if variant not in MAX_DEPTH_M:
        raise WeightsError(
            f"--variant is {variant or 'missing'}: expected indoor (Hypersim, 20 m) or outdoor (VKITTI, 80 m); the "
            f"tensors of {source.name} do not tell, nor whether they are of a relative model, which is of no use here"
        )
    if known is not None and known.variant != variant:
        raise WeightsError(f"{source.name} is the {known.variant} file by its name: expected --variant {known.variant}")
    return variant


def _entry(source: Path, kind: str, tensors: Mapping[str, torch.Tensor], variant: str) -> Weights:
    """Entry of the manifest to which the tensors belong: by name, else by kind, size and variant."""
    known = of_file(source.name)
    if known is not None and known.kind == kind:
        return known
    size = _size(kind, tensors)
    if kind == "dust3r":
        variant = "linear" if "downstream_head1.proj.weight" in tensors else "dpt"
    for weights in ALL:
        if weights.kind == kind and size in ("", weights.size) and variant in ("", weights.variant):
            return weights
    raise WeightsError(f"{source} is {kind} of size {size}: expected a network that is in `garps weights list`")


def _size(kind: str, tensors: Mapping[str, torch.Tensor]) -> str:
    """Size of a network, vits to vitg, by the width of the tokens or of a head; empty for a kind of one size."""
    width = 0
    if kind.startswith("ade20k"):
        width = tensors["decode_head.conv_seg.weight"].shape[1] // (4 if kind == "ade20k_ms" else 1)
    elif kind in ("depth_anything", "dinov2"):
        width = next((tensor.shape[-1] for key, tensor in tensors.items() if key.endswith("cls_token")), -1)
    return _SIZES.get(width, "unknown") if width else ""


def _metadata(weights: Weights) -> dict[str, str]:
    described = {
        "format": "pt",
        "kind": weights.kind,
        "licence": weights.licence,
        "size": weights.size,
        "variant": weights.variant,
        "max_depth_m": "" if weights.max_depth_m is None else f"{weights.max_depth_m:g}",
    }
    return {key: value for key, value in described.items() if value}
