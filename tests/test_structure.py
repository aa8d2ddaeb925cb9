"""The structure that the code is to keep: who may import whom, how long things may be, and that names exist once."""

import ast
import re
import sys
import tomllib
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

import warpmag
from warpmag.declarations import magnets

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ROOT / "kernels"
ROOMS = (
    *("shared", "material", "pairs", "eddy", "fmm", "applied", "cells", "induction", "near_contact", "rigid"),
    "contacts",
)
"""Rooms of ``kernels/``; each may import those before it that its ``__init__`` names."""
HOST_ROOMS = (
    *("declarations", "shapes", "moments", "usd", "usd/read", "usd/write", "engine/magnets", "engine/pile_xpbd"),
    *("engine/stepping", "show", "examples"),
)
"""Rooms of ``warpmag/``, likewise. All rooms may import the modules of ``warpmag/`` itself but the command."""
FACADES = ("warpmag/__init__.py", "warpmag/usd/__init__.py")
"""Modules that hand on the names of rooms after them; ``import warpmag.usd`` counts as an import of ``usd/write``."""
MOST_ROOT_MODULES = 12
LONGEST_FUNCTION, LONGEST_FILE, LONGEST_STRING = 60, 450, 10
"""[lines]; a longer string is text of another language, which belongs into a file of its own."""
REPEATED = {
    "MU0": "the oracle is independent of what it tests",
    "allocate": "of each set of buffers, called as its module's",
}
"""Public names that several modules may have, and why."""
OWNERS = {
    "newton": (  # the command opens viewers
        *("warpmag/engine", "warpmag/show", "warpmag/examples", "warpmag/cli.py"),
        "warpmag/isaaclab.py",
    ),
    "newton._src": ("warpmag/engine/pile_xpbd",),
    "warp._src": ("warpmag/engine/pile_xpbd", "warpmag/moments/tape.py"),  # the active tape
    "pxr": ("warpmag/usd", "warpmag/show"),
    "warp": (
        *("warpmag/moments", "warpmag/engine", "warpmag/show", "warpmag/examples"),
        *("warpmag/terminal.py", "warpmag/kernel_loading.py"),
        *("warpmag/isaaclab.py", "warpmag/torch.py", "warpmag/jax.py"),
    ),
    "isaaclab": ("warpmag/isaaclab.py",),
    "isaaclab_newton": ("warpmag/isaaclab.py",),
    "torch": ("warpmag/isaaclab.py", "warpmag/torch.py"),
    "jax": ("warpmag/jax.py",),
    "bench": (),
    "tests": (),
}
"""Folders and modules of ``warpmag/`` that may import a library; for the command, the terminal keeps Warp
quiet and the loading of kernels is timed."""
OPENINGS = re.compile(r"(What|How|Whether|Where|Those|Of|That|Which|Who)\b")
"""First words of a docstring that hide its subject."""
BRITISH = re.compile(
    r"\b(\w*colour\w*|centre[sd]?|neighbour\w*|behaviour\w*|magnetis(e|ed|es|ing|ation)\w*|modell(ed|ing)|licence|\w*metres?|grey|"
    r"favour\w*|normalis\w+|optimis\w+|symmetris\w+|initialis\w+|travell\w+)\b",
    re.IGNORECASE,
)
"""British spellings."""

SOURCES = {path.relative_to(KERNELS): path.read_text(encoding="utf-8") for path in sorted(KERNELS.rglob("*.py"))}
HEADERS = {path.relative_to(KERNELS): path.read_text(encoding="utf-8") for path in sorted(KERNELS.rglob("*.h"))}
TREES = {path: ast.parse(text) for path, text in SOURCES.items()}
HOST_TREES = {
    path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted((ROOT / "warpmag").rglob("*.py"))
}
OUTSIDE_TREES = {
    path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8"))
    for folder in ("bench", "scenes_usd")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
"""Benchmarks, and what authors the bundled scenes."""
TEST_TREES = {
    path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted((ROOT / "tests").rglob("*.py"))
}
MODULES = {".".join(("warpmag.kernels", *path.with_suffix("").parts)): path for path in SOURCES}


def imports(tree) -> list[tuple[str, int]]:
    """Every dotted name that is imported anywhere in a tree, and its line: ``a.b`` for ``from a import b``."""
    results = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            results += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            results += [("." * node.level + f"{node.module or ''}.{alias.name}", node.lineno) for alias in node.names]
    return results


def functions(tree):
    """Every function of a tree, those within others, too."""
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def line_count(node) -> int:
    """Lines of a node, decorators included."""
    decorators = getattr(node, "decorator_list", [])
    return node.end_lineno - min([node.lineno, *(decorator.lineno for decorator in decorators)]) + 1


def docstring_lines(node) -> int:
    """Lines of the docstring of a function, a class or a module."""
    return line_count(node.body[0]) if ast.get_docstring(node) is not None else 0


def strings(path):
    """Line and number of lines of every string that is no docstring, without its quotes."""
    tree = TREES[path]
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    skipped |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str)):
            if id(node) not in skipped and node.end_lineno > node.lineno:
                source = ast.get_source_segment(SOURCES[path], node) or ""
                yield node.lineno, source.strip("frb\"' \n").count("\n") + 1


def public_names(tree):
    """Public classes, functions and constants of a module that it defines itself, not in a function."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        else:
            continue
        yield from (name for name in names if not name.startswith("_"))


def rooms_named_in(docstring: str) -> set[str]:
    """Rooms that a room may import, by what its docstring says."""
    sentence = re.search(r"May import\s(.*?)\.(\s|$)", docstring, re.DOTALL)
    return set(re.findall(r"``([\w/]+)``", sentence.group(1))) if sentence else set()


MAY_IMPORT = {room: rooms_named_in(ast.get_docstring(TREES[Path(room, "__init__.py")]) or "") for room in ROOMS}


def test_rooms_form_a_line():
    assert {path.parts[0] for path in SOURCES} == {*ROOMS, "__init__.py"}
    installed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    assert {f"warpmag.kernels.{room}" for room in ROOMS} < set(installed)
    for place, room in enumerate(ROOMS):
        assert MAY_IMPORT[room] <= set(ROOMS[:place]), room


def test_kernels_import_warp_numpy_and_rooms_before_them():
    wrong = []
    for path, tree in TREES.items():
        may = {path.parts[0]} | MAY_IMPORT.get(path.parts[0], set())
        for name, line in imports(tree):
            library, *rest = name.split(".")
            if name.startswith("warpmag.kernels."):
                allowed = rest[1] in may
            else:
                allowed = library in ("warp", "numpy") or library in sys.stdlib_module_names
            if not allowed:
                wrong.append(f"{path}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_headers_include_headers_of_rooms_before_them():
    wrong = []
    for path, text in HEADERS.items():
        may = {path.parts[0]} | MAY_IMPORT[path.parts[0]]
        for included in re.findall(r'^#include "(.+)"', text, re.MULTILINE):
            if Path(included) not in HEADERS or Path(included).parts[0] not in may:
                wrong.append(f"{path} includes {included}")
    assert not wrong, "\n".join(wrong)


def test_no_circles():
    graph = {}
    for path, tree in TREES.items():
        names = {name for name, _ in imports(tree)}
        # ``from a import b`` imports module a.b if there is one, else module a
        graph[path] = {
            MODULES[n] for name in names for n in [name if name in MODULES else name.rpartition(".")[0]] if n in MODULES
        }
    for path, text in HEADERS.items():
        graph[path] = {Path(included) for included in re.findall(r'^#include "(.+)"', text, re.MULTILINE)}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle: {' ← '.join(map(str, error.args[1]))}")


def test_functions_files_and_strings_are_short():
    long = [
        f"{path}: {lines} lines"
        for path, text in (SOURCES | HEADERS).items()
        if (lines := text.count("\n")) > LONGEST_FILE
    ]
    for path, tree in TREES.items():
        long += [
            f"{path}:{f.lineno} {f.name}: {line_count(f)} lines"
            for f in functions(tree)
            if line_count(f) > LONGEST_FUNCTION
        ]
        long += [f"{path}:{line} string: {lines} lines" for line, lines in strings(path) if lines > LONGEST_STRING]
    assert not long, "\n".join(long)


def test_host_functions_and_files_are_short():
    """Without docstrings: those of host code are what a user reads of it, arguments, units and errors."""
    documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module
    long = []
    for path, tree in (HOST_TREES | OUTSIDE_TREES).items():
        text = (ROOT / path).read_text(encoding="utf-8")
        lines = text.count("\n") - sum(docstring_lines(n) for n in ast.walk(tree) if isinstance(n, documented))
        if lines > LONGEST_FILE:
            long.append(f"{path}: {lines} lines")
        for f in functions(tree):
            if (lines := line_count(f) - docstring_lines(f)) > LONGEST_FUNCTION:
                long.append(f"{path}:{f.lineno} {f.name}: {lines} lines")
    assert not long, "\n".join(long)


def test_names_exist_once():
    homes = defaultdict(list)
    for path, tree in TREES.items():
        for name in set(public_names(tree)) - set(REPEATED):
            homes[name].append(f"kernels/{path}")
    for path, tree in HOST_TREES.items():
        if path.match("warpmag/examples/*"):
            continue  # each stands alone, to be copied
        defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for name in (
            set(public_names(tree)) - defined - set(REPEATED)
        ):  # functions are called as their module's: oracle.h_field
            homes[name].append(str(path))
    wrong = [f"{name}: {', '.join(paths)}" for name, paths in sorted(homes.items()) if len(paths) > 1]
    assert not wrong, "\n".join(wrong)


def test_only_their_owners_import_libraries():
    wrong = []
    for path, tree in HOST_TREES.items():
        for name, line in imports(tree):
            for library, owners in OWNERS.items():
                if f"{name}.".startswith(f"{library}.") and not path.as_posix().startswith(owners):
                    wrong.append(f"{path}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def host_room(path: Path) -> str:
    """Room of a module of ``warpmag/``, "" for its root."""
    folder = path.parent.relative_to("warpmag").as_posix()
    return folder if folder in HOST_ROOMS else ""


def host_imports(tree) -> list[tuple[Path, int]]:
    """Modules of ``warpmag/`` that a tree imports, and the lines."""
    modules = []
    for name, line in imports(tree):
        if name.startswith("warpmag.") and not name.startswith(("warpmag.kernels", "warpmag.scenes_usd")):
            parts = name.split(".")
            places = [Path(*parts[:-1], f"{parts[-1]}.py"), Path(*parts, "__init__.py")]
            places += [Path(*parts[:-2], f"{parts[-2]}.py"), Path(*parts[:-1], "__init__.py")]
            modules += [(next(place for place in places if place in HOST_TREES), line)]
    return modules


MAY_HOST_IMPORT = {
    room: rooms_named_in(ast.get_docstring(HOST_TREES[Path("warpmag", room, "__init__.py")]) or "")
    for room in HOST_ROOMS
}


def test_host_rooms_form_a_line():
    folders = {path.parent.relative_to("warpmag").as_posix() for path in HOST_TREES} - {".", "engine"}
    assert folders == set(HOST_ROOMS)
    for place, room in enumerate(HOST_ROOMS):
        assert MAY_HOST_IMPORT[room] <= set(HOST_ROOMS[:place]), room


def test_host_rooms_import_rooms_before_them():
    wrong = []
    for path, tree in HOST_TREES.items():
        room = host_room(path)
        if path.as_posix() in FACADES or not room:
            continue
        for module, line in host_imports(tree):
            imported = "usd/write" if module == Path("warpmag/usd/__init__.py") else host_room(module)
            if imported not in {"", room} | MAY_HOST_IMPORT[room] or module == Path("warpmag/cli.py"):
                wrong.append(f"{path}:{line} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_no_circles_in_host_code():
    graph = {path: {module for module, _ in host_imports(tree) if module != path} for path, tree in HOST_TREES.items()}
    graph[Path("warpmag/__init__.py")] = set()  # loads names when they are first used
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle: {' ← '.join(map(str, error.args[1]))}")


def test_root_holds_little():
    assert len([path for path in HOST_TREES if path.parent == Path("warpmag")]) <= MOST_ROOT_MODULES


ALL_TREES = {**HOST_TREES, **OUTSIDE_TREES, **{Path("kernels", path): tree for path, tree in TREES.items()}}


def test_docstrings_open_with_their_subject():
    documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module
    wrong = []
    for path, tree in ALL_TREES.items():
        for node in ast.walk(tree):
            text = ast.get_docstring(node) if isinstance(node, documented) else None
            if text and OPENINGS.match(text):
                wrong.append(f"{path}:{getattr(node, 'lineno', 1)} {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)


def test_variables_are_named_after_what_they_hold():
    wrong = []
    for path, tree in (ALL_TREES | TEST_TREES).items():
        for node in ast.walk(tree):
            name = node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else ""
            name = node.arg if isinstance(node, ast.arg) else name
            if name in ("one", "found"):
                wrong.append(f"{path}:{node.lineno} {name}")
    assert not wrong, "\n".join(wrong)


def test_spelling_is_american():
    texts = {path: (ROOT / path).read_text(encoding="utf-8") for path in ALL_TREES}
    texts |= {Path("kernels", path): text for path, text in HEADERS.items()}
    texts |= {Path(page): (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
    wrong = [
        f"{path}:{number} {match.group()}"
        for path, text in texts.items()
        for number, line in enumerate(text.splitlines(), 1)
        for match in BRITISH.finditer(line)
    ]
    assert not wrong, "\n".join(wrong)


PAGES = ["ARCHITECTURE.md", "CONTRIBUTING.md", "README.md", "bench/README.md"]
PAGES += [
    path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md")) if path.parent.name != "paper"
]


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_files_that_exist(page):
    names = set(re.findall(r"`((?:[\w.]+/)+[\w.]*)`", (ROOT / page).read_text(encoding="utf-8")))
    folders = ROOT, ROOT / "warpmag", KERNELS
    assert {name for name in names if not any((folder / name).exists() for folder in folders)} == set()


def test_tokens_have_their_numbers_in_kernels(device):
    from warpmag.kernels.induction.submagnetization import LAW_IDS  # noqa: PLC0415 - imports Warp
    from warpmag.kernels.material.curves import CURVE_IDS  # noqa: PLC0415

    assert tuple(CURVE_IDS) == magnets.CURVES
    assert {"theta", *LAW_IDS} == set(magnets.DYNAMICS)


def test_moved_modules_import_by_their_earlier_names():
    for earlier, present in warpmag._MOVED.items():
        sys.modules.pop(earlier, None)
        with pytest.warns(DeprecationWarning, match=f"{earlier} is now {present}"):
            module = import_module(earlier)
        names = [name for name in vars(import_module(present)) if not name.startswith("_")]
        assert names and all(getattr(module, name) is getattr(import_module(present), name) for name in names)


def test_an_earlier_module_does_not_hide_the_function_of_its_name():
    sys.modules.pop("warpmag.export", None)
    with pytest.warns(DeprecationWarning, match="warpmag.export is now warpmag.show.export"):
        import_module("warpmag.export")
    try:
        with pytest.raises(warpmag.InputError, match="fps: must be positive"):
            warpmag.export("no.usda", "out.usdc", fps=0.0)
    finally:
        vars(warpmag).pop("export")
