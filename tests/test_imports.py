"""Imports run downward only, and the top imports little."""

import ast
import graphlib
import json
import os
import pathlib
import subprocess
import sys

import pytest

from paths import ROOT

MAY_IMPORT = {
    "trap_tube_jax": {"trap_tube_jax"},
    "agents": {"agents", "trap_tube_jax"},
    "benchmarks": {"benchmarks", "agents", "trap_tube_jax"},
}
# Lower rooms never import higher ones. Modules of a package itself are rooms of their own.
ENVIRONMENT = (
    ("_version", "by_value", "checks", "imports", "command_line", "tables"),
    ("objects", "geometry", "prng"),
    ("state", "positions"),
    ("dynamics", "layouts", "transfers", "graded", "observation"),
    ("environment", "wrappers", "vector"),
    ("controls", "registry"),
    ("rendering", "solver"),
    ("scoring",),
    ("adapters", "gallery", "play"),
)
AGENTS = (
    ("arrays", "command_line", "registry"),
    ("config",),
    ("parallel",),
    ("networks",),
    ("acting",),
    ("curiosity",),
    ("ppo",),
    ("pretrained", "runs"),
    ("train",),
    ("experiments", "profiles", "sweep"),
    ("evaluate", "examples", "profile"),
)
LEARNING = ("registry", "config", "parallel", "networks", "acting", "curiosity", "ppo")
SOURCES = sorted(path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py"))
# The project's other dependencies, and what only its extras install.
HEAVY = {"PIL", "chex", "gymnasium", "gymnax", "matplotlib", "optax", "orbax", "tyro"}


def module_name(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path) for path in SOURCES}


def imported_modules(path: pathlib.Path, tree: ast.AST) -> set[str]:
    """Absolute names of the imported modules, with relative imports resolved."""
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package = package[:-1]
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                submodule = f"{module}.{alias.name}"
                names.add(submodule if submodule in MODULES else module)
    return names


class WithoutFunctions(ast.NodeTransformer):
    """Leaves what runs on import; functions import later."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        del node


def test_the_sources_are_found():
    assert {"trap_tube_jax.dynamics", "agents", "benchmarks"} <= MODULES


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_imports_run_downward(path):
    package = module_name(path).split(".")[0]
    own = {name.split(".")[0] for name in imported_modules(path, ast.parse(path.read_text()))}
    assert own & set(MAY_IMPORT) <= MAY_IMPORT[package]


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


@pytest.mark.parametrize(
    ("package", "rooms"),
    [("trap_tube_jax", ENVIRONMENT), ("agents", AGENTS)],
    ids=["env", "agents"],
)
def test_rooms_import_downward(package, rooms):
    level = {name: height for height, names in enumerate(rooms) for name in names}
    for path in SOURCES:
        own = module_name(path)
        if own.startswith(f"{package}."):
            for name in imported_modules(path, ast.parse(path.read_text())) & MODULES:
                if name.startswith(f"{package}."):
                    assert level[room(name)] <= level[room(own)], (own, name)


def test_training_imports_no_command_line(tmp_path):
    """Nor tyro or matplotlib: learning needs arrays alone."""
    program = "import json, sys, agents; print(json.dumps(sorted(sys.modules)))"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=environment, cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    modules = set(json.loads(result.stdout))
    rooms = {room(name) for name in modules if name.startswith("agents.")}
    assert rooms == set(LEARNING)
    assert not modules & {"tyro", "matplotlib"}


def test_no_module_needs_itself():
    graph = {}
    for path in SOURCES:
        tree = WithoutFunctions().visit(ast.parse(path.read_text()))
        graph[module_name(path)] = imported_modules(path, tree) & MODULES - {module_name(path)}
    graphlib.TopologicalSorter(graph).prepare()


def test_importing_the_environment_is_light(tmp_path):
    """Checked in a fresh interpreter: what JAX, Flax and NumPy import themselves is free."""
    program = """
import json, sys
import jax, numpy
from flax import struct
sys.modules["gymnasium"] = None  # which importing the environment registers with
before = set(sys.modules)
import trap_tube_jax
print(json.dumps([sorted(before), sorted(set(sys.modules) - before)]))
"""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    before, added = ({name.split(".")[0] for name in names} for names in json.loads(result.stdout))
    assert "trap_tube_jax" in added
    assert added - before - set(sys.stdlib_module_names) == {"trap_tube_jax"}
    assert not added & HEAVY
    assert not before & {"agents", "benchmarks"}
