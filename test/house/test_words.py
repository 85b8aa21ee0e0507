# SPDX-License-Identifier: Apache-2.0
"""One name for one thing, and sentences: no retired word in any tracked text, every docstring complete in itself."""

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

RETIRED = {
    r"glances?": "brightness_search, photometric search",
    r"sharpen(s|ed|ing)?": "refine",
    r"sight": "brightness; `line of sight` is allowed",
    r"beliefs?": "start",
    r"beginnings?": "start, starting pose",
    r"systematic": "depth errors",
    r"remark(s|ed)?": "warning, note",
    r"troubles?": "warning, reason",
    r"doubt(s|ed|ing)?": "warning, reason",
    r"so many": "a number, or a sentence of its own",
    r"likewise": "a sentence of its own",
    r"descend(s|ed|ing)?": "ascend, step, minimise",
    r"climb(s|ed|ing)?": "ascend, step, maximise",
    r"findings": "candidates in the core, checks in the diagnostics",
    r"seen[_ ]closely": "the pairs of the solution",
    r"initial( |-)poses?": "start, starting pose",
    r"its worth|worth of|worth the share|how much (it|they|that) (is|are) worth": "weight, effective measurements",
    r"known: WeightedStart|known\.(T|precision|error_precision|joint)": "start",
}
"""Regular expressions of whole words, in any case and also as parts of identifiers; and what to use instead."""
CASED = {
    r"Belief|Glance|Sharpen": "WeightedStart, brightness, refine",
    r"Findings?|\b_?finding(?=[(:=]|\.\w)|\w_finding\b": "Candidate in the core, Check in the diagnostics",
}
"""Regular expressions that look at the case: inside of CamelCase, and where the word alone is an ordinary one."""
PHRASES = ("line of sight", "lines of sight")
"""Standard terms that hold a retired word."""
SUFFIXES = {".py", ".md", ".rst", ".yaml", ".yml", ".xml"}

NO_SUBJECT = re.compile(r"(Of|What|As|Which|So|Where|How) |(Likewise|Which|The same)\b")
CAPITAL_OR_CODE = re.compile(r"[A-Z0-9`(\[\"]|\w*_\w")


def tracked() -> list[Path]:
    """Texts under version control, but the licence and this table. Outside of a checkout, those of its folders."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        folders = ("garps_core", "garps_ros", "msg_adapters", "bench", "test", "docs", "config", "launch")
        found = [*ROOT.glob("*"), *(path for folder in folders for path in (ROOT / folder).rglob("*"))]
    else:
        found = [ROOT / line for line in listed.stdout.splitlines()]
    there = (path for path in found if path.suffix in SUFFIXES and path.is_file())
    return sorted(path for path in there if path != Path(__file__).resolve())


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def whole(word: str) -> re.Pattern[str]:
    """A word with no letter beside it, across the end of a line too; `_` and digits end it."""
    spaced = word.replace(" ", r"[ \n#*]+")
    return re.compile(rf"(?<![A-Za-z])(?:{spaced})(?![A-Za-z])", re.I)


PATTERNS = [(whole(word), instead) for word, instead in RETIRED.items()]
PATTERNS += [(re.compile(word), instead) for word, instead in CASED.items()]


def retired_in(text: str) -> list[str]:
    """Line, word and what to write instead, of every retired word of a text."""
    for phrase in PHRASES:
        text = whole(phrase).sub(lambda found: re.sub(r"[^\n]", "-", found[0]), text)
    return [
        f"line {text.count(chr(10), 0, found.start()) + 1}: {found[0]!r}, write: {instead}"
        for pattern, instead in PATTERNS
        for found in pattern.finditer(text)
    ]


@pytest.mark.parametrize("path", tracked(), ids=name)
def test_no_retired_word(path: Path) -> None:
    found = retired_in(f"{path.stem}\n{path.read_text('utf-8')}")
    assert not found, "\n".join([f"{name(path)} (line 1 is its name, add one to each):", *found])


def test_retired_words_are_found_and_ordinary_ones_are_not() -> None:
    assert len(retired_in("by_sight = Belief()\nso\nmany findings: Finding")) == 6
    assert not retired_in("docs/troubleshooting.md: finding the line of\nsight by gradient descent, unworthy")


def documented() -> list[Path]:
    """Files whose docstrings are read by others."""
    folders = ("garps_core", "garps_ros", "msg_adapters", "bench")
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of all strings that stand alone: of the module, of classes, functions, constants and fields."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value


def ends_well(text: str) -> bool:
    """Whether it ends with a period, or with a block of usage, which is indented."""
    last = text.rstrip().splitlines()[-1]
    return last.endswith((".", ".)")) or ("\n" in text.strip() and last.startswith("    "))


def wrong_with(text: str) -> str:
    """Why a docstring is no sentence; "" where it is one."""
    start = text.strip()
    if not start:
        return "is empty"
    if not CAPITAL_OR_CODE.match(start):
        return "does not start with a capital letter, code or a digit"
    if NO_SUBJECT.match(start):
        return "starts without a subject"
    return "" if ends_well(text) else "does not end with a period"


@pytest.mark.parametrize("path", documented(), ids=name)
def test_docstrings_are_sentences(path: Path) -> None:
    found = [
        f"{name(path)}:{line} {why}: {text[:60]!r}" for line, text in docstrings(path) if (why := wrong_with(text))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("Return the pose.", True),
        ("`python -m bench.run`: every method on every pair.", True),
        ("4x4 pose.", True),
        ("T_target_source, metres.", True),
        ("Write the page.\n\n    python -m garps_ros.parameters.docs", True),
        ("Of the pose.", False),
        ("The same for depth.", False),
        ("what it is.", False),
        ("No period", False),
        ("Whatever comes first.", True),
    ],
)
def test_a_sentence_is_recognised(text: str, right: bool) -> None:
    assert bool(wrong_with(text)) != right
