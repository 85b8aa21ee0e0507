# SPDX-License-Identifier: Apache-2.0
"""The wings of `bench` import in one order and in no circle, and a data set is one file and one line."""

import ast
import re

import pytest
from places import ROOT

BENCH = ROOT / "bench"
WINGS = ("rooms", "machine", "training", "pairs", "peers", "rows", "scoring", "report")
COMMANDS = ("speed", "networks", "live", "demo")
ORDER = (*WINGS, *COMMANDS)
NOT_A_DATA_SET = {"__init__", "dataset_files", "pairs_json", "sfm_scale"}


def modules() -> dict[str, set[str]]:
    """Each module of `bench` and those of `bench` that it imports, anywhere in its text."""
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in BENCH.rglob("*.py")}
    found: dict[str, set[str]] = {name: set() for name in files}
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bench"):
                for alias in node.names:
                    module = f"{node.module}.{alias.name}"
                    found[name].add(module if module in files else node.module)
    return found


MODULES = modules()


def wing(module: str) -> int:
    """Place in the order; commands that are single files come last."""
    name = module.split(".")[1]
    return ORDER.index(name) if name in ORDER else len(ORDER)


def test_every_folder_has_its_place_in_the_order_and_on_the_map():
    folders = {path.name for path in BENCH.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert folders == set(ORDER)
    described = ast.get_docstring(ast.parse((BENCH / "__init__.py").read_text(encoding="utf-8")))
    assert re.findall(r"(?<!/)\b(\w+)/(?= |,)", described.partition("The modules")[0]) == list(ORDER)


@pytest.mark.parametrize("module", MODULES)
def test_a_wing_imports_only_from_wings_before_it(module):
    assert {needed for needed in MODULES[module] if wing(needed) > wing(module)} == set()


def test_nothing_imports_in_a_circle():
    done: set[str] = set()

    def visit(module, trail):
        assert module not in trail, " -> ".join((*trail, module))
        if module not in done:
            for needed in MODULES.get(module, ()):
                visit(needed, (*trail, module))
            done.add(module)

    for module in MODULES:
        visit(module, ())


def test_a_data_set_is_one_file_and_one_line():
    """Outside its own file, a reader's module is named in the registry alone; `bench.sample` is RealEstate10K's own."""
    readers = {path.stem for path in (BENCH / "pairs/readers").glob("*.py")} - NOT_A_DATA_SET
    registry = "bench.pairs.readers.__init__"
    for name in readers - {"pair_list", "realestate10k"}:
        module = f"bench.pairs.readers.{name}"
        assert [user for user, needed in MODULES.items() if module in needed] == [registry]
    assert {f"bench.pairs.readers.{name}" for name in readers} <= MODULES[registry]
