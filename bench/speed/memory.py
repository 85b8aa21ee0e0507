# SPDX-License-Identifier: Apache-2.0
"""Peak memory of fresh processes: one pair from its images, and large mixtures with all components used."""

from __future__ import annotations

import numpy as np

from bench.report.checks import Check, Row, Section
from bench.speed.fresh import arrays_of, arrays_of_mixtures, in_fresh_process
from bench.speed.growth import fine_mixtures, subset
from bench.speed.parts import Inputs

COMPONENTS, NEIGHBOURS = 100_000, 20
BAR_MIB = 1024.0


def memory_section(inputs: Inputs, components: int = COMPONENTS, neighbours: int = NEIGHBOURS) -> Section:
    """Peak resident memory of two fresh processes: a pair from its images, and an alignment of large mixtures."""
    images = in_fresh_process("estimate", arrays_of(inputs.pairs[0]), inputs.preset)
    source, target = (subset(mixture, components) for mixture in fine_mixtures(inputs))
    arrays = arrays_of_mixtures(source, target, inputs.prior) | {"neighbours": np.array(neighbours)}
    large = in_fresh_process("align", arrays, inputs.preset)
    peak = large["done"]
    what = f"{components} components x {neighbours}"
    checks = [
        Check(f"peak memory of the whole process, MiB, {what}", peak, BAR_MIB),
        Check(f"of it beyond imports, MiB, {what}", peak - large["imports"], BAR_MIB),
        Check("peak memory of the whole process, MiB, a pair from its images", images["done"]),
    ]
    rows = [_line("a pair from its images", images), _line(f"alignment, {what}", large)]
    return Section("Peak memory of fresh processes, MiB", checks, rows, raw=[images, large])


def _line(name: str, told: Row) -> Row:
    return {"process": name} | {key: told[key] for key in ("imports", "loaded", "done", "done twice", "packages")}
