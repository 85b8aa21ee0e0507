# SPDX-License-Identifier: Apache-2.0
"""The rules of the house, read from the source: who imports whom, what never appears, how long things may be."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

PACKAGES = ("garps_core", "msg_adapters", "garps_ros")
STDLIB = set(sys.stdlib_module_names)
TEXT = {".py", ".md", ".rst", ".txt", ".toml", ".cfg", ".xml", ".yaml", ".yml", ""}
SKIPPED = {"build", "install", "log", "dist", "out"}


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


PACKAGE_FILES = sources(*PACKAGES)
WEIGHTS_READER = ROOT / "garps_core/weights/reader.py"
WEIGHTS_FETCHER = ROOT / "garps_core/weights/fetch.py"
ALL_FILES = [*PACKAGE_FILES, *sources("bench", "test"), ROOT / "setup.py"]


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def modules_of(node: ast.AST) -> list[str]:
    """Absolute names of what an import statement brings in."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative imports hide who imports whom"
        return [node.module or ""]
    return []


def top(module: str) -> str:
    return module.split(".", maxsplit=1)[0]


def imports(path: Path) -> set[str]:
    """Top-level names of everything imported anywhere in a file."""
    return {top(module) for node in ast.walk(tree_of(path)) for module in modules_of(node)}


def imports_at_load(path: Path) -> set[str]:
    """The same, for what runs when the module is imported: not inside functions, not under TYPE_CHECKING."""
    found: set[str] = set()

    def visit(body: list[ast.stmt]) -> None:
        for node in body:
            found.update(map(top, modules_of(node)))
            if isinstance(node, (ast.If, ast.Try, ast.With, ast.ClassDef)):
                if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                    continue
                visit(node.body)
                visit(getattr(node, "orelse", []))
                for handler in getattr(node, "handlers", []):
                    visit(handler.body)

    visit(tree_of(path).body)
    return found


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node


def test_the_search_finds_the_packages() -> None:
    assert {"garps_core/align.py", "garps_core/cli/command.py"} <= {name(path) for path in PACKAGE_FILES}


@pytest.mark.parametrize("path", sources("garps_core"), ids=name)
def test_the_core_knows_no_ros_and_none_of_its_users(path: Path) -> None:
    allowed = STDLIB | {"garps_core", "numpy", "scipy", "cv2", "torch", "poselib", "typer", "rich"}
    if path.name == "figure.py":
        allowed = allowed | {"matplotlib"}
    if path.name == "loops.py":
        allowed = allowed | {"numba"}
    if path == ROOT / "garps_core/config/text.py":
        allowed = allowed | {"ruamel"}
    if path == WEIGHTS_READER:
        allowed = allowed | {"safetensors"}
    if path == WEIGHTS_FETCHER:
        allowed = allowed | {"huggingface_hub"}
        assert "huggingface_hub" not in imports_at_load(path)
    assert imports(path) <= allowed


@pytest.mark.parametrize("path", sources("msg_adapters"), ids=name)
def test_the_adapters_know_numpy_only(path: Path) -> None:
    """R1, R5: messages by attribute. OpenCV only inside the function that decodes a compressed image."""
    assert imports_at_load(path) <= STDLIB | {"msg_adapters", "numpy"}
    assert imports(path) <= STDLIB | {"msg_adapters", "numpy", "cv2"}


@pytest.mark.parametrize("path", sources("garps_ros"), ids=name)
def test_the_shell_is_not_built_on_bench_or_tests(path: Path) -> None:
    assert not imports(path) & {"bench", "test", "matplotlib", "plyfile", "open3d", "tf2_ros", "cv_bridge"}


WINGS = {
    "garps_core": (
        ("weights",),
        ("models",),
        ("mixtures",),
        ("start",),
        ("objective",),
        ("solver",),
        ("verdict",),
        ("mixture_alignment",),
        ("align",),
        ("cli",),
    ),
    "garps_ros": (("parameters",), ("frames",), ("estimates",), ("recording", "live"), ("pose_node", "replay")),
}
"""Folders and top files of a package in the order the data flows. What is not named is vocabulary, below them all."""


def imported_modules(path: Path) -> set[str]:
    """Every module of this repository that a file imports, also inside functions; a package stands for its __init__."""
    found: set[str] = set()
    for node in ast.walk(tree_of(path)):
        names = modules_of(node)
        if isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        found.update(name for name in names if is_module(name))
    return found


def is_module(dotted: str) -> bool:
    place = ROOT.joinpath(*dotted.split("."))
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """The folder or top file of a package that a module belongs to: garps_core.solver.ladder -> garps_core.solver."""
    return ".".join(module.split(".")[:2])


def arrows(*folders: str) -> dict[str, set[str]]:
    """Map a module to those of this repository that it imports, without packages named on the way to a part."""
    graph = {module_of(path): imported_modules(path) for path in sources(*folders)}
    return {
        module: {
            to for to in needed if to != module and not module.startswith(to + ".") and not is_on_the_way(to, needed)
        }
        for module, needed in graph.items()
    }


def is_on_the_way(package: str, needed: set[str]) -> bool:
    """`from garps_core.solver import ladder` needs ladder; the package is named on the way only."""
    return any(other.startswith(package + ".") for other in needed)


def longest_chain(graph: dict[str, set[str]]) -> list[str]:
    """The longest way along the arrows. Fails the test where the way leads in a circle."""
    done: dict[str, list[str]] = {}

    def chain(module: str, trail: tuple[str, ...]) -> list[str]:
        assert module not in trail, "a circle: " + " -> ".join((*trail, module))
        if module not in done:
            ways = [chain(to, (*trail, module)) for to in sorted(graph.get(module, ()))]
            done[module] = [module, *max(ways, key=len, default=[])]
        return done[module]

    return max((chain(module, ()) for module in sorted(graph)), key=len)


def between_rooms(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    rooms: dict[str, set[str]] = {}
    for module, needed in graph.items():
        room = room_of(module)
        rooms.setdefault(room, set()).update(room_of(to) for to in needed if room_of(to) != room)
    return rooms


@pytest.mark.parametrize("folders", [PACKAGES, ("bench",)], ids=["packages", "bench"])
def test_nothing_imports_in_a_circle(folders: tuple[str, ...]) -> None:
    graph = arrows(*folders)
    assert len(longest_chain(graph)) > 3, "the search finds arrows"
    assert longest_chain(between_rooms(graph))


@pytest.mark.parametrize("package", WINGS)
def test_a_wing_imports_from_wings_before_it_only(package: str) -> None:
    rank = {f"{package}.{name}": number for number, names in enumerate(WINGS[package], 1) for name in names}
    assert all(is_module(room) for room in rank)
    upward = [
        f"{module} imports {to}"
        for module, needed in arrows(package).items()
        for to in sorted(needed)
        if to.startswith(package + ".")
        and rank.get(room_of(to), 0) > rank.get(room_of(module), 0)
        and module != package
    ]
    assert upward == []


def test_the_core_is_at_most_ten_rooms_deep() -> None:
    rooms = {room: to for room, to in between_rooms(arrows("garps_core")).items() if room != "garps_core"}
    chain = longest_chain({room: {one for one in to if one in rooms} for room, to in rooms.items()})
    assert len(chain) <= 10, " -> ".join(chain)


def test_the_search_for_circles_and_chains_works() -> None:
    with pytest.raises(AssertionError, match="a -> b -> c -> a"):
        longest_chain({"a": {"b"}, "b": {"c"}, "c": {"a"}})
    assert longest_chain({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == ["a", "b", "c"]


@pytest.mark.parametrize("package", ["garps_core", "msg_adapters"])
def test_a_fresh_import_stays_light(package: str) -> None:
    """R3: no ROS, no plotting, no viewer; and the adapters need neither torch nor OpenCV."""
    heavy = ["rclpy", "rosbags", "open3d", "matplotlib", "plyfile", "typer", "safetensors", "huggingface_hub"]
    heavy += ["torch", "cv2", "scipy", "garps_core"] if package == "msg_adapters" else ["garps_ros", "msg_adapters"]
    code = f"import {package}, sys; print(*[m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


FORBIDDEN_MODULES = {
    *("pickle", "cPickle", "dill", "joblib", "cloudpickle", "shelve", "marshal"),
    *("urllib", "requests", "socket", "http", "ftplib", "httpx", "aiohttp", "huggingface_hub"),
}
FORBIDDEN_CALLS = {
    *("eval", "exec", "compile", "__import__"),
    *("torch.load", "torch.hub.load", "torch.hub.load_state_dict_from_url", "os.system", "yaml.load"),
}


def forbidden_in(tree: ast.Module) -> list[str]:
    found = []
    for node in ast.walk(tree):
        found += [module for module in modules_of(node) if top(module) in FORBIDDEN_MODULES]
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            words = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if called in FORBIDDEN_CALLS or called.endswith("from_pretrained"):
                found.append(called)
            if words.get("allow_pickle") == "True" or words.get("shell") == "True":
                found.append(f"{called}(allow_pickle or shell)")
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "torch.hub":
            found.append("torch.hub")
    return found


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=name)
def test_no_network_and_no_code_from_data(path: Path) -> None:
    """R4. Two files are the exceptions: one reads weights, safely, and one fetches them when a person says so."""
    allowed = {WEIGHTS_READER: {"torch.load"}, WEIGHTS_FETCHER: {"huggingface_hub"}}
    assert set(forbidden_in(tree_of(path))) <= allowed.get(path, set())


@pytest.mark.parametrize("path", [path for path in PACKAGE_FILES if path != WEIGHTS_READER], ids=name)
def test_weights_files_are_opened_in_one_place(path: Path) -> None:
    found = {ast.unparse(node) for node in ast.walk(tree_of(path)) if isinstance(node, (ast.Name, ast.Attribute))}
    found |= {
        alias.name for node in ast.walk(tree_of(path)) if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert not found & {"torch.load", "torch.jit.load", "safe_open", "load_file", "save_file", "safe_globals"}
    assert "safetensors" not in imports(path)


def test_weights_are_never_opened_without_protection() -> None:
    calls = [node for node in ast.walk(tree_of(WEIGHTS_READER)) if isinstance(node, ast.Call)]
    loads = [call for call in calls if ast.unparse(call.func) == "torch.load"]
    assert len(loads) == 1
    assert {word.arg: ast.unparse(word.value) for word in loads[0].keywords}["weights_only"] == "True"


def test_the_search_for_forbidden_things_works() -> None:
    for line in (
        "import pickle",
        "from urllib.request import urlopen",
        "eval('1')",
        "torch.load('a')",
        "torch.hub.load()",
    ):
        assert forbidden_in(ast.parse(line))
    assert not forbidden_in(ast.parse("np.load(path, allow_pickle=False); model.eval()"))


@pytest.mark.parametrize("path", ALL_FILES, ids=name)
def test_files_and_functions_stay_short(path: Path) -> None:
    """R6; a test file may hold a longer table of cases."""
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= (400 if path.is_relative_to(ROOT / "test") else 300), f"{lines} lines: split by topic"
    for function in functions(path):
        length = (function.end_lineno or 0) - function.lineno + 1
        assert length <= 60, f"{function.name} has {length} lines"


@pytest.mark.parametrize("path", ALL_FILES, ids=name)
def test_every_source_names_its_licence(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not text or text.startswith("# SPDX-License-Identifier: Apache-2.0\n")


def tracked_texts() -> Iterator[Path]:
    for path in ROOT.rglob("*"):
        parts = path.relative_to(ROOT).parts
        hidden = any(part.startswith(".") and part not in (".ci", ".gitignore") for part in parts)
        if path.is_file() and not hidden and not SKIPPED & set(parts) and path.suffix in TEXT:
            yield path


def test_nothing_depends_on_one_machine() -> None:
    machine = re.compile(r"(?<![\w.])/(?:" + "|".join(("home", "root", "work", "Users")) + r")/\w")
    hits = [
        f"{name(path)}:{number}"
        for path in tracked_texts()
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if machine.search(line)
    ]
    assert hits == []
