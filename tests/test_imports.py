"""Imports run downward only, the top imports little, and the wheel needs what it installs."""

import ast
import graphlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tomllib

import trap_tube_jax as tt
from helpers.paths import ROOT

# Lower rooms never import higher ones. A module directly in a package is a room, too.
ENVIRONMENT = (
    ("_version", "by_value", "checks", "imports", "interruptions", "command_line", "tables"),
    ("objects", "geometry", "prng"),
    ("state", "positions"),
    ("controls", "dynamics", "layouts", "transfers", "graded", "observation"),
    ("environment", "wrappers", "vector"),
    ("registry",),
    ("rendering", "solver"),
    ("scoring",),
    ("adapters", "play"),
)
AGENTS = (
    ("arrays", "command_line", "files", "registry"),
    ("config",),
    ("parallel",),
    ("networks",),
    ("acting",),
    ("curiosity", "fast"),
    ("ppo",),
    ("pretrained", "runs"),
    ("train",),
    ("profiles", "sweeps"),
    ("sweep",),
    ("evaluate", "examples", "experiments", "profile"),
)
PACKAGES = ("trap_tube_jax", "agents", "benchmarks")  # a package never imports a later one
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
# Libraries that neither importing the environment nor drawing text needs.
HEAVY = {"PIL", "chex", "gymnasium", "gymnax", "matplotlib", "optax", "pandas"}


def module_name(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for name in PACKAGES for path in (ROOT / name).rglob("*.py")}


class WithoutFunctions(ast.NodeTransformer):
    """Leaves what runs on import; functions import later."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        del node


def imported(tree: ast.AST) -> set[str]:
    """Absolute names of the imported modules; the project has no relative imports."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, ast.unparse(node)
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in SOURCES else str(node.module) for name in whole}
    return names


TREES = {name: ast.parse(path.read_text()) for name, path in SOURCES.items()}
IMPORTS = {name: imported(tree) for name, tree in TREES.items()}


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_imports_run_downward():
    assert {"trap_tube_jax.dynamics", "agents", "benchmarks"} <= SOURCES.keys()
    levels = {
        package: {name: height for height, names in enumerate(rooms) for name in names}
        for package, rooms in (("trap_tube_jax", ENVIRONMENT), ("agents", AGENTS))
    }
    for module, names in IMPORTS.items():
        package = module.split(".")[0]
        for name in names & SOURCES.keys():
            above = name.split(".")[0]
            assert PACKAGES.index(above) <= PACKAGES.index(package), (module, name)
            if above == package and package in levels and room(module) and room(name):
                level = levels[package]
                assert level[room(name)] <= level[room(module)], (module, name)
    graph = {
        name: (imported(WithoutFunctions().visit(tree)) & SOURCES.keys()) - {name}
        for name, tree in TREES.items()
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises if a module needs itself


def test_the_fast_path_has_one_door():
    """Without its folder and its tests, everything else works; see `agents.ppo.machine`."""
    users = {
        name
        for name, names in IMPORTS.items()
        if any(used.startswith("agents.fast") for used in names)
    }
    assert {name for name in users if not name.startswith("agents.fast")} == {"agents.ppo.machine"}


def modules_after(program: str, folder: pathlib.Path) -> list[set[str]]:
    """Runs a program that prints lists of modules as its last line, in a fresh interpreter."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-W", "error", "-c", program]
    environment = os.environ | {"PYTHONPATH": path}
    output = subprocess.check_output(command, env=environment, cwd=folder, text=True)
    return list(map(set, json.loads(output.splitlines()[-1])))


def test_nothing_is_unpickled():
    """Reading somebody's file runs none of its code."""
    for module, tree in TREES.items():
        assert not IMPORTS[module] & {
            "pickle",
            "cloudpickle",
            "dill",
            "joblib",
            "marshal",
            "shelve",
        }
        assert not re.search("allow_pickle|read_pickle", ast.unparse(tree)), module


def test_signals_end_every_command_alike():
    """Examples are programs to copy, and no commands."""
    commands = {
        module: ast.unparse(tree.body[-1])
        for module, tree in TREES.items()
        if tree.body and "__main__" in ast.unparse(tree.body[-1])
    }
    assert {"agents.train", "trap_tube_jax.play", "benchmarks.peers"} <= commands.keys()
    for module, code in commands.items():
        if not module.startswith("agents.examples."):
            assert re.search(r"\b(run_command|harness\.run)\(", code), module


def test_the_environment_is_light(tmp_path):
    """Libraries that JAX, Flax and NumPy import themselves are free."""
    program = """
import json, sys
import jax, numpy
from flax import struct
sys.modules["gymnasium"] = None  # which importing the environment registers with
before = set(sys.modules)
import trap_tube_jax as tt
print(tt.render_ascii(tt.make("base").reset(jax.random.key(0))[0]))
ours = {name for name in set(sys.modules) - before if not name.startswith(("jax", "numpy"))}
print(json.dumps([sorted(before), sorted(ours)]))
"""
    before, added = (
        {name.split(".")[0] for name in names} for names in modules_after(program, tmp_path)
    )
    assert added - before - set(sys.stdlib_module_names) == {"trap_tube_jax"}
    assert not added & HEAVY
    assert not before & {"agents", "benchmarks"}


def modules_of(requirements: list[str]) -> set[str]:
    found = (re.split(r"[\[>=]", requirement)[0] for requirement in requirements)
    return {{"pillow": "PIL"}.get(name, name) for name in found}


def test_the_wheel_holds_the_environment_and_requires_its_imports():
    project = SETTINGS["project"]
    build = SETTINGS["tool"]["hatch"]
    assert build["build"]["targets"]["wheel"] == {"packages": ["trap_tube_jax"]}
    extras = project["optional-dependencies"]
    required = modules_of(project["dependencies"])
    allowed = required | modules_of(extras["pictures"] + extras["gymnasium"] + extras["gymnax"])
    used = set()
    for module, names in IMPORTS.items():
        if module.split(".")[0] == "trap_tube_jax":
            imported = {name.split(".")[0] for name in names} - {"trap_tube_jax"}
            assert imported <= allowed | sys.stdlib_module_names, module
            used |= imported
    assert required <= used


def test_all_files_name_the_same_version():
    assert SETTINGS["tool"]["hatch"]["version"] == {"path": "trap_tube_jax/_version.py"}
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    changed = re.findall(
        r"^## (\S+), \d{4}-\d{2}-\d{2}$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert cited == changed[:1] == [tt.__version__]
