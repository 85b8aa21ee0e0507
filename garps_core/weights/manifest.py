# SPDX-License-Identifier: Apache-2.0
"""The weights files of others that GARPS knows: name, licence, where they come from. It ships none of them.

No checksum is known in advance: the first fetch or verification records it (`garps_core.weights.store`), and from then
on it is checked.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from garps_core.errors import WeightsError

PERMISSIVE = frozenset({"Apache-2.0", "BSD-3-Clause", "MIT"})
APACHE = "Apache-2.0"
NON_COMMERCIAL = "CC BY-NC 4.0, non-commercial"
SHARE_ALIKE = "CC BY-NC-SA 4.0 and the terms of the training data, non-commercial"
UNLICENSED = "none stated, all rights reserved"

MAX_DEPTH_M = {"indoor": 20.0, "outdoor": 80.0}
"""Range of the metric Depth Anything networks, trained on Hypersim and Virtual KITTI; their files do not say it."""
NEEDS_NAMESPACE = frozenset({"mast3r", "dust3r"})
"""Kinds whose `.pth` files hold an argparse.Namespace beside the tensors."""

_AUTHORS_DINOV2 = "https://dl.fbaipublicfiles.com/dinov2"


@dataclass(frozen=True)
class Weights:
    """One weights file.

    Attributes:
        name: what is typed, e.g. `depth-anything-v2-indoor-small`.
        file: its name at the source.
        kind: depth_anything, flash3d, dinov2, ade20k_linear, ade20k_ms, m2f, mast3r or dust3r.
        licence: of the weights, not of the code.
        what: what it is for, a few words.
        bytes_bound: no file of this name is larger.
        repo: owner/name on the hub, None where the file is not there.
        url: the authors' own server, where a person can download it.
        bytes: exact size, None = not known in advance.
        sha256: of the file, None = recorded on first use.
        size: backbone, vits, vitb, vitl or vitg.
        variant: indoor or outdoor, or the head; what the tensors do not tell.
        max_depth_m: range of a metric depth network.
    """

    name: str
    file: str
    kind: str
    licence: str
    what: str
    bytes_bound: int
    repo: str | None = None
    url: str | None = None
    bytes: int | None = None
    sha256: str | None = None
    size: str = ""
    variant: str = ""
    max_depth_m: float | None = None

    @property
    def needs_acceptance(self) -> bool:
        """Whether the licence is anything but a permissive one."""
        return self.licence not in PERMISSIVE

    @property
    def local(self) -> str:
        """File name inside the weights folder: that of the source, except where it is the same for many."""
        return f"{self.name}.safetensors" if self.file == "model.safetensors" else self.file


def megabytes(count: float) -> int:
    """Bytes of a number of MB."""
    return round(count * 1e6)


def _depth_anything() -> Iterator[Weights]:
    sizes = (("small", "vits", 110), ("base", "vitb", 420), ("large", "vitl", 1400))
    for (size, vit, bound), (variant, data) in (
        (a, b) for a in sizes for b in (("indoor", "Hypersim"), ("outdoor", "VKITTI"))
    ):
        official = Weights(
            f"depth-anything-v2-{variant}-{size}",
            f"depth_anything_v2_metric_{data.lower()}_{vit}.pth",
            "depth_anything",
            APACHE if size == "small" else NON_COMMERCIAL,
            f"metric depth, {variant}, up to {MAX_DEPTH_M[variant]:g} m",
            megabytes(bound),
            repo=f"depth-anything/Depth-Anything-V2-Metric-{data}-{size.title()}",
            size=vit,
            variant=variant,
            max_depth_m=MAX_DEPTH_M[variant],
        )
        yield official
        yield replace(
            official,
            name=f"{official.name}-hf",
            file="model.safetensors",
            repo=f"depth-anything/Depth-Anything-V2-Metric-{variant.title()}-{size.title()}-hf",
        )


def _dinov2() -> Iterator[Weights]:
    sizes = (("small", "s", 95), ("base", "b", 360), ("large", "l", 1260), ("giant", "g", 4700))
    for size, letter, bound in sizes:
        vit, folder = f"vit{letter}", f"{_AUTHORS_DINOV2}/dinov2_vit{letter}14"
        backbone = Weights(
            f"dinov2-{size}",
            f"dinov2_{vit}14_pretrain.pth",
            "dinov2",
            APACHE,
            "image features for the labels",
            megabytes(bound),
            url=f"{folder}/dinov2_{vit}14_pretrain.pth",
            size=vit,
        )
        yield backbone
        hub = replace(backbone, name=f"dinov2-{size}-hf", file="model.safetensors", url=None)
        yield replace(hub, repo=f"facebook/dinov2-{size}")
        for head in ("linear", "ms"):
            file = f"dinov2_{vit}14_ade20k_{head}_head.pth"
            yield replace(
                backbone,
                name=f"dinov2-{size}-ade20k-{head}",
                file=file,
                kind=f"ade20k_{head}",
                what=f"labels (ADE20K) from dinov2-{size}",
                bytes_bound=megabytes(8),
                url=f"{folder}/{file}",
                variant=head,
            )


def _naver() -> Iterator[Weights]:
    page = "https://download.europe.naverlabs.com/ComputerVision"
    for name, kind, model, bound in (
        ("mast3r", "mast3r", "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric", 2900),
        ("dust3r-dpt", "dust3r", "DUSt3R_ViTLarge_BaseDecoder_512_dpt", 2400),
        ("dust3r-linear", "dust3r", "DUSt3R_ViTLarge_BaseDecoder_512_linear", 2250),
        ("dust3r-linear-224", "dust3r", "DUSt3R_ViTLarge_BaseDecoder_224_linear", 2250),
    ):
        what = "start pose" if kind == "mast3r" else "start pose, for comparison"
        variant = name.partition("-")[2]
        hub = Weights(
            name,
            "model.safetensors",
            kind,
            SHARE_ALIKE,
            what,
            megabytes(bound),
            repo=f"naver/{model}",
            size="vitl",
            variant=variant,
        )
        yield hub
        folder = "MASt3R" if kind == "mast3r" else "DUSt3R"
        yield replace(hub, name=f"{name}-pth", file=f"{model}.pth", repo=None, url=f"{page}/{folder}/{model}.pth")


_FLASH3D = Weights(
    "flash3d",
    "model_re10k_v2.pth",
    "flash3d",
    UNLICENSED,
    "Gaussians from one image",
    megabytes(3000),
    repo="einsafutdinov/flash3d",
    variant="re10k_v2",
)
_M2F = Weights(
    "dinov2-giant-ade20k-m2f",
    "dinov2_vitg14_ade20k_m2f.pth",
    "m2f",
    APACHE,
    "labels (ADE20K), as in the paper",
    megabytes(21_000),  # an optimiser's state may be in it
    url=f"{_AUTHORS_DINOV2}/dinov2_vitg14/dinov2_vitg14_ade20k_m2f.pth",
    size="vitg",
    variant="m2f",
)

ALL: tuple[Weights, ...] = (*_depth_anything(), _FLASH3D, *_dinov2(), _M2F, *_naver())
"""All weights; within each kind the smallest with the freest licence comes first."""
BY_NAME = {weights.name: weights for weights in ALL}


def named(name: str) -> Weights:
    """The entry of that name; WeightsError with the nearest names if there is none."""
    if name in BY_NAME:
        return BY_NAME[name]
    near = difflib.get_close_matches(name, BY_NAME, 3, 0.5)
    hint = f"did you mean {', '.join(map(repr, near))}?" if near else "`garps weights list` shows them"
    raise WeightsError(f"no weights are named {name!r}: {hint}")


def of_file(file: str) -> Weights | None:
    """The entry whose file, at the source or in the weights folder, has this name."""
    known = {weights.local: weights for weights in ALL}
    return known.get(file)


def licence_of(file: str, metadata: Mapping[str, str], kind: str) -> str:
    """Licence of weights by the name of their file, else by what is stored in it, else the strictest of their kind."""
    known = of_file(file)
    if known is not None:
        return known.licence
    licences = [weights.licence for weights in ALL if weights.kind == kind]
    return metadata.get("licence") or next((one for one in licences if one not in PERMISSIVE), licences[0])


def range_of(file: str, metadata: Mapping[str, str], variant: str, option: str) -> float:
    """Largest depth (m) of a metric depth network, which its tensors do not tell.

    Args:
        file: name of the file. metadata: what is stored in it.
        variant: indoor or outdoor, as the user says; "" = as the name or the metadata says.
        option: where the user says it.
    Raises:
        WeightsError: no source tells it, the sources contradict each other, or it is a relative model's file.
    """
    if re.fullmatch(r"depth_anything_v2_vit[sblg]\.(pth|safetensors)", file):
        raise WeightsError(f"{file} is the name of a relative model: expected a metric one, as in `garps weights list`")
    known, told = of_file(file), metadata.get("max_depth_m")
    if known is not None and known.max_depth_m and variant in ("", known.variant):
        return known.max_depth_m
    if told in ("20", "80") and variant in ("", metadata.get("variant")):
        return float(told)
    if known is not None or told or variant not in MAX_DEPTH_M:
        of = known.variant if known else metadata.get("variant", "indoor or outdoor")
        raise WeightsError(f"{option} is {variant or 'missing'}: expected {of} for {file}")
    return MAX_DEPTH_M[variant]
