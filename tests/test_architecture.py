"""The structure of the package: imports point down the table in CONTRIBUTING, and names mean one thing."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from exported import names_of
from jax.typing import DTypeLike
from numpy.typing import ArrayLike

import reframe_jax
from reframe_jax import tuning

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "reframe_jax"
SNAPSHOT = ROOT / "tests" / "public_names.txt"


def layers() -> list[str]:
    """Packages in the order of the table in CONTRIBUTING, the lowest first."""
    table = (ROOT / "CONTRIBUTING.md").read_text().split("| package |")[1].split("\n\n")[0]
    return re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def parse(file: Path) -> ast.Module:
    return ast.parse(file.read_text())


def imports(file: Path) -> set[str]:
    """Modules of this package that a file imports anywhere, inside functions too."""
    found = set()
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            assert node.module is not None
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return {name for name in found if name.split(".")[0] == "reframe_jax"}


def test_the_table_names_every_package() -> None:
    parts = {path.stem for path in PACKAGE.iterdir() if path.name[0] not in "_." and path.suffix != ".typed"}
    assert sorted(layers()) == sorted(parts)


def test_there_are_at_most_forty_tuned_constants() -> None:
    assert len([*tuning.MOTION, *tuning.EVIDENCE, *tuning.SEGMENTS]) <= 40


def test_imports_point_down_the_table() -> None:
    order, wrong = layers(), []
    for file in PACKAGE.rglob("*.py"):
        importer = module_name(file)
        if importer in ("reframe_jax", "reframe_jax._public", "reframe_jax.__main__"):
            continue
        for imported in imports(file):
            layer = imported.split(".")[1] if "." in imported else ""
            if layer not in order:  # __version__ and the like
                continue
            if order.index(layer) > order.index(importer.split(".")[1]):
                wrong.append(f"{importer} imports {imported}, which is above it")
    assert not wrong, "\n".join(wrong)


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    names = {module_name(file): file for file in PACKAGE.rglob("*.py")}
    graph = {
        name: {
            target
            for imported in imports(file)
            for target in (imported, imported.rpartition(".")[0])
            if target in names and target != name and not name.startswith(target + ".")
        }
        for name, file in names.items()
    }
    packages = {name for name, file in names.items() if file.name == "__init__.py"}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path, name])
        if name in done:
            return
        for target in sorted(graph[name] - packages):
            visit(target, (*path, name))
        done.add(name)

    for name in sorted(graph.keys() - packages):
        visit(name, ())


def test_the_core_imports_no_extra_and_no_simulator() -> None:
    """They take as long as everything else together; functions that need them import them."""
    code = "import sys, reframe_jax; reframe_jax.identify; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    heavy = {"mujoco", "pandas", "pyarrow", "matplotlib", "viser", "dask", "PIL"}
    assert "jax" in loaded
    assert not loaded & heavy


def walk() -> list[ModuleType]:
    found = [reframe_jax]
    for info in pkgutil.walk_packages(reframe_jax.__path__, "reframe_jax."):
        if info.name != "reframe_jax.__main__":
            found.append(importlib.import_module(info.name))
    return found


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_function_hides_a_module() -> None:
    hidden = []
    for module in walk():
        for info in pkgutil.iter_modules(getattr(module, "__path__", [])):
            thing = getattr(module, info.name, None)
            if thing is not None and not inspect.ismodule(thing):
                hidden.append(f"{module.__name__}.{info.name} is a {type(thing).__name__}")
    assert not hidden, hidden


def members_of(thing: type) -> dict[str, Any]:
    """Members of a class, also those that it inherits from classes of this package."""
    own = [base for base in reversed(thing.__mro__) if base.__module__.startswith("reframe_jax")]
    members = {m: None for base in own for m in getattr(base, "__annotations__", {})}
    return members | {m: value for base in own for m, value in vars(base).items()}


def signature(name: str) -> str:
    thing = getattr(reframe_jax, name)
    if callable(thing) and not inspect.isclass(thing):
        parameters = inspect.signature(thing).parameters.values()
        return f"{name}({', '.join(('*' if p.kind == p.KEYWORD_ONLY else '') + p.name for p in parameters)})"
    if inspect.isclass(thing):
        members = [m for m in members_of(thing) if not m.startswith("_")]
        return f"class {name}: {', '.join(sorted(members))}"
    return f"{name}: {type(thing).__name__}"


NUMPY_TYPES = (ArrayLike, DTypeLike, *typing.get_args(ArrayLike), *typing.get_args(DTypeLike))


def public_callables() -> dict[str, Callable[..., Any]]:
    """Functions, and methods of classes, of the flat name space and of the modules of the documentation."""
    page = (ROOT / "docs" / "api-modules.md").read_text()
    found: dict[str, Callable[..., Any]] = {}
    for name in ["reframe_jax", *re.findall(r"^\.\. automodule:: (\S+)$", page, re.MULTILINE)]:
        module = importlib.import_module(name)
        for public in names_of(module):
            thing = getattr(module, public)
            if inspect.isclass(thing):
                for method in members_of(thing):
                    member = inspect.unwrap(getattr(thing, method, None))
                    shown = method in ("__init__", "__call__", "__getitem__") or method[0] != "_"
                    if (
                        shown
                        and callable(member)
                        and inspect.isroutine(member)
                        and member.__module__ != "typing"
                    ):
                        found[f"{public}.{method}"] = member
            elif inspect.isroutine(inspect.unwrap(thing)):
                found[public] = inspect.unwrap(thing)
    return found


def mentions_any(annotation: Any) -> bool:
    """Whether Any is the annotation or a part of it, or there is none; NumPy's own types do not count."""
    if isinstance(annotation, str):
        return re.search(r"\bAny\b", annotation) is not None
    if annotation in (Any, inspect.Parameter.empty):
        return True
    if annotation in NUMPY_TYPES or typing.get_origin(annotation) in (np.ndarray, np.dtype):
        return False
    parts = typing.get_args(annotation)
    parts = (*parts[0], *parts[1:]) if parts and isinstance(parts[0], list) else parts
    return any(mentions_any(part) for part in parts)


def test_public_arguments_have_types() -> None:
    callables = public_callables()
    methods = {
        "Demonstration.__getitem__",
        "BasinHopping.minimise",
        "ValleySteps.__call__",
        "Joint.__init__",
    }
    assert {"simulate", *methods} <= set(callables)
    untyped = {
        f"{name}({parameter.name})"
        for name, function in callables.items()
        for parameter in inspect.signature(function).parameters.values()
        if parameter.name not in ("self", "cls") and mentions_any(parameter.annotation)
    }
    assert not untyped, "arguments typed as Any"


def test_the_check_of_types_sees_any() -> None:
    for wrong in (Any, list[Any], Any | None, Callable[[Any], int], dict[str, tuple[int, Any]]):
        assert mentions_any(wrong)
    for right in (int, ArrayLike, ArrayLike | None, np.ndarray, Callable[[int], str], str | None):
        assert not mentions_any(right)


def test_public_names_are_frozen() -> None:
    """A change here is a change of the public interface: say so in CHANGELOG.md, then edit the file."""
    now = "\n".join(signature(name) for name in sorted(reframe_jax.__all__)) + "\n"
    assert now == SNAPSHOT.read_text(), "the public names differ from tests/public_names.txt"
