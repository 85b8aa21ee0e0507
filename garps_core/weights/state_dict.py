# SPDX-License-Identifier: Apache-2.0
"""Tensors by name -> a network, strictly: all that it needs, nothing else, every value finite."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import torch
from torch import nn

from garps_core.errors import WeightsError

Optional = Callable[[str], bool] | str | None

# What a file is told by: every pattern must match some key. The first row that fits wins, so the particular come first.
_TELLING = (
    ("mast3r", "MASt3R", (r"^dec_blocks\.0\.cross_attn\.", r"^downstream_head1\.head_local_features\.")),
    ("dust3r", "DUSt3R with a DPT head", (r"^dec_blocks\.0\.cross_attn\.", r"^downstream_head1\.dpt\.")),
    ("dust3r", "DUSt3R with a linear head", (r"^dec_blocks\.0\.cross_attn\.", r"^downstream_head1\.proj\.")),
    ("croco", "CroCo, which MASt3R and DUSt3R began from", (r"^dec_blocks\.0\.cross_attn\.",)),
    ("flash3d", "Flash3D", (r"(^|\.)models\.gauss_decoder_[01]\.",)),
    ("sharp", "Apple SHARP", (r"^monodepth_model\.",)),
    ("m2f", "DINOv2 with a Mask2Former head", (r"^decode_head\.pixel_decoder\.", r"^backbone\.interactions\.")),
    ("depth_anything", "Depth Anything, official names", (r"^pretrained\.blocks\.0\.", r"^depth_head\.")),
    ("depth_anything", "Depth Anything, transformers names", (r"^backbone\.encoder\.layer\.0\.", r"^neck\.")),
    ("dinov2", "a DINOv2 backbone, official names", (r"^patch_embed\.proj\.", r"^blocks\.0\.", r"^pos_embed$")),
    ("dinov2", "a DINOv2 backbone, transformers names", (r"^(dinov2\.)?embeddings\.", r"encoder\.layer\.0\.")),
    ("segmentation_head", "an ADE20K head", (r"^decode_head\.conv_seg\.", r"^decode_head\.bn\.")),
    ("unidepth", "UniDepth", (r"^pixel_encoder\.", r"^pixel_decoder\.")),
)
_UNKNOWN = ("", "a network that is not known here")


def load_strictly(
    module: nn.Module,
    tensors: Mapping[str, torch.Tensor],
    what: str,
    optional: Optional = "num_batches_tracked$",
    dtype: torch.dtype | None = torch.float32,
) -> None:
    """Copy every tensor to the parameter or buffer of its name.

    The module may be on the meta device: it then gets its memory here, on the CPU. It never shares memory with
    `tensors`, which may be a mapped file.

    Args:
        module: the network; its own device is kept.
        tensors: all of them by the module's own names, the caller having dropped those it does not use.
        what: the network in words, for errors.
        optional: names that may be absent, as a function or a pattern to search for; they keep what the module has,
            or become zero where it has nothing yet.
        dtype: of everything that is floating point; None = as in the file.
    Raises:
        WeightsError: missing, unexpected or misshaped tensors, with the first and the count of each; values that are
            not finite, with their name.
    """
    own = module.state_dict()
    _check_names(own, tensors, what, _predicate(optional))
    loaded = {key: _converted(key, tensors.get(key), value, what, dtype) for key, value in own.items()}
    module.load_state_dict(loaded, strict=True, assign=True)


def recognised(tensors: Mapping[str, object]) -> str:
    """Kind of file that the names of the tensors tell of, in words."""
    return _told(tensors)[1]


def kind_of(tensors: Mapping[str, object]) -> str:
    """Kind of weights, as in `manifest.Weights.kind`; empty where the names do not tell it.

    The two heads on DINOv2 share their names and are told apart by width, since ade20k_ms sees four blocks; only 1536
    may be either.
    """
    kind = _told(tensors)[0]
    if kind == "segmentation_head":
        weight = tensors.get("decode_head.conv_seg.weight")
        width = weight.shape[1] if isinstance(weight, torch.Tensor) and weight.dim() == 4 else 0
        return "ade20k_linear" if width in (384, 768, 1024) else "ade20k_ms" if width in (3072, 4096, 6144) else ""
    return kind


def check_finite(tensors: Mapping[str, torch.Tensor], what: str) -> None:
    """WeightsError naming the first tensor with a value that is not finite."""
    for key, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            count = int((~torch.isfinite(tensor)).sum())
            raise WeightsError(
                f"{what}: {key} has {count} of {tensor.numel()} values that are not finite: expected numbers; the file "
                "is damaged or its training went wrong: fetch it again"
            )


def _told(tensors: Mapping[str, object]) -> tuple[str, str]:
    for kind, words, patterns in _TELLING:
        if all(any(re.search(pattern, key) for key in tensors) for pattern in patterns):
            return kind, words
    return _UNKNOWN


def _predicate(optional: Optional) -> Callable[[str], bool]:
    if isinstance(optional, str):
        pattern = re.compile(optional)
        return lambda key: pattern.search(key) is not None
    return optional or (lambda _: False)


def _check_names(
    own: Mapping[str, torch.Tensor], given: Mapping[str, torch.Tensor], what: str, optional: Callable[[str], bool]
) -> None:
    missing = [key for key in own if key not in given and not optional(key)]
    unexpected = [key for key in given if key not in own]
    misshaped = [key for key in own if key in given and not _fits(own[key], given[key])]
    faults = []
    if missing:
        faults.append(f"{len(missing)} of {len(own)} tensors are missing, the first {missing[0]}")
    if unexpected:
        faults.append(f"{len(unexpected)} are unexpected, the first {unexpected[0]}")
    if misshaped:
        first = misshaped[0]
        sizes = f"{_size(given[first])}, expected {_size(own[first])}"
        faults.append(f"{len(misshaped)} are of another shape, the first {first}: {sizes}")
    if faults:
        raise WeightsError(f"no weights of {what}: {'; '.join(faults)}; by its names the file is {recognised(given)}")


def _fits(own: torch.Tensor, given: torch.Tensor) -> bool:
    return own.shape == given.shape and own.is_floating_point() == given.is_floating_point()


def _size(tensor: torch.Tensor) -> str:
    return f"{'x'.join(map(str, tensor.shape)) or 'one'} {str(tensor.dtype).removeprefix('torch.')}"


def _converted(
    key: str, given: torch.Tensor | None, own: torch.Tensor, what: str, dtype: torch.dtype | None
) -> torch.Tensor:
    device = torch.device("cpu") if own.is_meta else own.device
    if given is None:
        return torch.zeros_like(own, device=device) if own.is_meta else own
    wanted = (dtype or given.dtype) if given.is_floating_point() else own.dtype
    copy = given.detach().to(device=device, dtype=wanted, copy=True, memory_format=torch.contiguous_format)
    check_finite({key: copy}, what)
    return copy
