# SPDX-License-Identifier: Apache-2.0
"""Writes docs/parameters.md and config/garps.yaml from the parameters themselves.

`python -m garps_ros.parameters.docs` writes both, `--check` only says (exit code 1) whether one of them is stale.
"""

from __future__ import annotations

import argparse
import json
import sys
import textwrap
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from garps_core.config import PRESETS
from garps_ros.parameters.parameter import Parameter, Value, parameters

ROOT = Path(__file__).resolve().parents[2]
TYPES = {bool: "bool", int: "integer", float: "double", str: "string"}
GROUPS = {
    "node": ("The node", "What is subscribed, paired and published."),
    "reconstruction": ("`reconstruction`", "What turns a view into a mixture, and which weights networks use."),
    "lifting": ("`lifting`", "How a pixel with depth becomes a Gaussian: the sensor model."),
    "start": ("`start`", "Where the alignment starts."),
    "alignment": ("`alignment`", "The objective and how it is maximised; what a pose must hold to be published."),
    "paper": ("`paper`", "The published method, used where `method` is paper."),
    "": ("The estimator as a whole", "Where and in which arithmetic it runs."),
}
OTHER_PRESETS = tuple(name for name in PRESETS if name not in ("default", "sensor"))
INDENT = " " * 4

INTRODUCTION = """\
# Parameters of the live node

Generated from the settings in `garps_ros/parameters/settings.py` and `garps_core/config/`; change those, then run
`python -m garps_ros.parameters.docs`.

`pose_node` has two kinds of parameters: its own, and every setting of the estimator under the name it has everywhere
else (`lifting.stride` here is `--set lifting.stride=4` of `garps-replay`). `preset` chooses the values that the
estimator's settings start from: `default` and `sensor` (the same today) for measured depth, `time_of_flight`,
`structured_light` and `stereo` for depth of that kind, `monocular` for a network's depth, `paper` for the published
method. A single setting given beside it stands above the preset. The annealing ladders are tables and no parameters;
they come with the preset.

## Setting them

In a file, of which `config/garps.yaml` is one with everything in it:

```yaml
/**:
  ros__parameters:
    preset: monocular
    sync_slop: 0.03
    lifting.stride: 4
```

```bash
ros2 run garps_ros pose_node --ros-args --params-file my.yaml
ros2 run garps_ros pose_node --ros-args -p pairing:=keyframe -p lifting.max_range_m:=5.0 -p rectified:="'true'"
ros2 param set /pose_node lifting.stride 4
ros2 param describe /pose_node lifting.stride
```

In a Python launch file: `Node(package="garps_ros", executable="pose_node", parameters=["my.yaml", {"sync_slop":
0.03}])`; what comes later stands above what came before.

**Types.** ROS takes `5` for an integer and refuses it for a double: write `5.0`. It takes `true` for a bool and
refuses it for a string: `rectified` needs quotes, `"true"` in a file and `"'true'"` in a shell.

**Mistakes.** A wrong type, a value out of range or a misspelt name at the start is one line, and the node does not
start. A name unlike all of these is taken for another node's and noted in the log. While the node runs, a wrong
change is refused with its reason and nothing is changed; several parameters that are set together change together or
not at all.

**Live.** What is live may be changed while the node runs (`ros2 param set`) and holds from the next pair on; the rest
is fixed at the start.
"""

FILE_HEAD = """\
# SPDX-License-Identifier: Apache-2.0
# Every parameter of pose_node with its default: meaning [range, unit]. Generated: python -m garps_ros.parameters.docs
# A double needs its point (5.0, never 5); text that looks like something else needs quotes ("true").
# The estimator's settings are commented out (#name) so that `preset` decides them; without its # one stands above it.
/**:
  ros__parameters:
"""


def page() -> str:
    """The text of docs/parameters.md."""
    others = {preset: {p.name: p.default for p in parameters(preset)} for preset in OTHER_PRESETS}
    lines = [INTRODUCTION]
    for group, members in groupby(parameters(), key=lambda parameter: parameter.group):
        title, meaning = GROUPS[group]
        lines += [f"## {title}\n", meaning + "\n"]
        lines += [
            "| name | type | default | range or choices | unit | live | meaning |",
            "|---|---|---|---|---|---|---|",
        ]
        for parameter in members:
            presets = {} if group == "node" else {preset: values[parameter.name] for preset, values in others.items()}
            lines.append(_row(parameter, presets))
        lines.append("")
    return "\n".join(lines)


def _row(parameter: Parameter, presets: dict[str, Value]) -> str:
    defaults = [f"`{written(parameter.default)}`"]
    defaults += [f"{name} `{written(value)}`" for name, value in presets.items() if value != parameter.default]
    limits = ", ".join(f"`{choice}`" for choice in parameter.choices) or _range(parameter)
    cells = [
        f"`{parameter.name}`",
        TYPES[type(parameter.default)],
        "; ".join(defaults),
        limits,
        parameter.unit,
        "yes" if parameter.live else "no",
        parameter.doc,
    ]
    return "| " + " | ".join(cells) + " |"


def _range(parameter: Parameter) -> str:
    if parameter.low is None or parameter.high is None:
        return ""
    kind = type(parameter.default)
    return f"{written(kind(parameter.low))} .. {written(kind(parameter.high))}"


def written(value: Value) -> str:
    """A value as YAML that keeps its type, for ROS and for PyYAML alike (which takes 1e-05 for text, 1.0e-05 not)."""
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition("e")
        return mantissa + (".0" if e and "." not in mantissa else "") + e + exponent
    return json.dumps(value)


def yaml_file() -> str:
    """The text of config/garps.yaml: the node's parameters with their defaults, the estimator's commented out."""
    lines = [FILE_HEAD.rstrip()]
    for group, members in groupby(parameters(), key=lambda parameter: parameter.group):
        title, meaning = GROUPS[group]
        lines.append(f"\n{INDENT}# ---- {title.replace('`', '')}: {meaning}")
        for parameter in members:
            lines += _entry(parameter)
    return "\n".join(lines) + "\n"


def _entry(parameter: Parameter) -> Iterator[str]:
    limits = ", ".join(parameter.choices) or _range(parameter)
    brackets = " ".join(word for word in (limits, parameter.unit) if word)
    fixed = "" if parameter.live else " (fixed at the start)"
    meaning = parameter.doc + (f" [{brackets}]" if brackets else "") + fixed
    yield from textwrap.wrap(meaning, 120, initial_indent=f"{INDENT}# ", subsequent_indent=f"{INDENT}#   ")
    mark = "" if parameter.group == "node" else "#"
    yield f"{INDENT}{mark}{parameter.name}: {written(parameter.default)}"


def main(arguments: list[str] | None = None) -> int:
    """Write both files; with --check write nothing and return 1 when one of them is stale."""
    parser = argparse.ArgumentParser(prog="python -m garps_ros.parameters.docs", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 when a file is stale")
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout to write into")
    options = parser.parse_args(arguments)
    if not (options.root / "setup.py").exists():
        parser.error(f"{options.root} is no checkout (it has no setup.py): give --root")
    stale = False
    for path, text in (("docs/parameters.md", page()), ("config/garps.yaml", yaml_file())):
        file: Path = options.root / path
        if file.exists() and file.read_text(encoding="utf-8") == text:
            continue
        stale = True
        if options.check:
            print(f"{path} is stale: run python -m garps_ros.parameters.docs", file=sys.stderr)
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
            print(f"wrote {path}")
    return int(stale and options.check)


if __name__ == "__main__":
    sys.exit(main())
