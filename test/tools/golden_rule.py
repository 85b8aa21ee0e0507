# SPDX-License-Identifier: Apache-2.0
"""Golden values of the published networks: the rule that fills their parameters, their inputs, and the comparison.

`test/golden/NAME.keys.json` lists the keys and shapes of a checkpoint file, `NAME.npz` holds samples of what the
official modules compute with parameters filled by this rule. It uses integers and correctly rounded float64 only, so
every machine gets the same bits. The parameters are pseudo-random: the outputs mean nothing, they only have to agree.
"""

import json
import re
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt
from places import GOLDEN

FOLDER = GOLDEN
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))

Array = npt.NDArray[Any]
Table = list[list[Any]]


def unit(name: str, n: int) -> Array:
    """`n` numbers in (-1, 1), float64, each exact in float32: SplitMix64, seeded by the name's CRC-32."""
    u = np.uint64

    def mix(z: Array) -> Array:
        z = (z ^ (z >> u(30))) * u(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> u(27))) * u(0x94D049BB133111EB)
        return np.asarray(z ^ (z >> u(31)))

    seed = mix(np.array([zlib.crc32(name.encode()) + 1], dtype=u))
    z = mix(np.arange(1, n + 1, dtype=u) * u(0x9E3779B97F4A7C15) + seed)
    return np.asarray((2 * (z >> u(40)).astype(np.int64) + (1 - 2**24)) / 2.0**24)


def affine(key: str, shape: tuple[int, ...], table: Table) -> tuple[float, float]:
    """(offset, scale) of one tensor. table: the network's list of [regex, offset, scale, gain]; the first hit wins."""
    fan = shape[0] if len(shape) == 4 and shape[2] in (2, 4) else int(np.prod(shape[1:]))
    gain = 1.0
    for pattern, offset, scale, g in table:
        if re.search(pattern, key):
            if g is None:
                return offset, scale
            gain = g
            break
    fixed = {
        "running_mean": (0.0, 0.1),
        "running_var": (1.0, 0.2),
        "gamma": (0.55, 0.45),
        "pos_embed": (0.0, 0.3),
        "cls_token": (0.0, 0.5),
        "mask_token": (0.0, 0.02),
        "bias": (0.0, 0.05),
    }
    last = key.rsplit(".", 1)[-1]
    if last in fixed:
        return fixed[last]
    if len(shape) == 1:
        return 1.0, 0.1  # norm weights
    return 0.0, gain * float(np.sqrt(3.0 / fan))  # conv and linear weights, variance gain^2 / fan


def fill(key: str, shape: tuple[int, ...], table: Table) -> Array:
    if key.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    offset, scale = affine(key, shape, table)
    return np.asarray((offset + scale * unit(key, int(np.prod(shape)))).reshape(shape).astype(np.float32))


def keys(name: str) -> dict[str, Any]:
    """The whole keys file: architecture, inputs, gain table, files, aliases, unused."""
    found: dict[str, Any] = json.loads((FOLDER / f"{name}.keys.json").read_text(encoding="utf-8"))
    return found


def state(name: str, file: str | None = None) -> dict[str, Array]:
    """The filled parameters of one checkpoint file of a network (the only one when `file` is not given)."""
    described = keys(name)
    (listed,) = described["files"].values() if file is None else (described["files"][file],)
    filled = {key: fill(key, tuple(shape), described["table"]) for key, shape, *_ in listed}
    for key, shape, _, _, crc in listed:
        assert zlib.crc32(filled[key].tobytes()) == crc, f"{key} {shape}: other bits than in the golden file"
    return filled


def image(h: int, w: int, x0: int = 0, y0: int = 0, name: str = "image") -> npt.NDArray[np.uint8]:
    """hxwx3 uint8 RGB; integer arithmetic only."""
    y, x = np.mgrid[y0 : y0 + h, x0 : x0 + w]
    rgb = np.stack(
        [
            abs((5 * x + 2 * y) % 510 - 255),
            abs((3 * y - 2 * x) % 510 - 255),
            255 * ((x // 24 + y // 20) % 2),
        ],
        -1,
    )
    rgb[(x - 90) ** 2 + (y - 60) ** 2 < 1600] = (230, 40, 60)
    noise = np.trunc(24 * unit(name, h * w * 3)).astype(np.int64).reshape(h, w, 3)
    return np.clip(rgb + noise, 0, 255).astype(np.uint8)


def depth(h: int, w: int) -> npt.NDArray[np.float32]:
    """hxw float32 metres, about 2..7."""
    y, x = np.mgrid[0:h, 0:w]
    d = 2 + 3 * y / (h - 1) + 1.5 * ((x // 64 + y // 64) % 2) + 0.5 * abs(x % 96 - 48) / 48
    return (d + 0.05 * unit("depth", h * w).reshape(h, w)).astype(np.float32)


def chw(rgb: Array, mean: tuple[float, ...], std: tuple[float, ...]) -> npt.NDArray[np.float32]:
    """uint8 hxwx3 -> float32 1x3xhxw; computed in float64, then cast once."""
    v = (rgb / 255.0 - np.array(mean)) / np.array(std)
    return np.ascontiguousarray(v.transpose(2, 0, 1)[None].astype(np.float32))


def compare(name: str, ours: dict[str, Any]) -> dict[str, float]:
    """Largest error / tolerance per tensor of `NAME.npz` that `ours` (name -> whole array) has; fails above 1."""
    ratio = {}
    with np.load(FOLDER / f"{name}.npz") as z:
        tensors = json.loads(bytes(z["meta"]))["tensors"]
        unknown = set(ours) - set(tensors)
        assert not unknown, f"not in {name}.npz: {sorted(unknown)}"
        for tensor, meta in tensors.items():
            if tensor not in ours:
                continue
            full = np.asarray(ours[tensor])
            assert list(full.shape) == meta["shape"], f"{tensor}: {full.shape} against {meta['shape']}"
            sample = full[tuple(slice(a, None, b) for a, b in zip(meta["start"], meta["step"], strict=True))]
            if tensor.endswith("labels"):  # compared only where the decision is clear
                sure = z[tensor.replace("labels", "margin")] > 2 * tensors[tensor.replace("labels", "full")]["tol"]
                assert sure.any() and (sample == z[tensor])[sure].all(), tensor
                continue
            error = float(np.abs(sample.astype(np.float64) - z[tensor]).max())
            assert error <= meta["tol"], f"{tensor}: off by {error:.3g}, tolerance {meta['tol']:.3g}"
            ratio[tensor] = error / meta["tol"] if meta["tol"] else 0.0
    return ratio
