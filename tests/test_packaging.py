"""The version, in every place that names it, and what the wheel holds and needs."""

import ast
import re
import sys
import tomllib

import trap_tube_jax as tt
from paths import ROOT

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
MODULES = {"pillow": "PIL"}  # where the distribution has another name


def names(requirements):
    """The modules of these requirements."""
    found = (re.split(r"[\[>=]", requirement)[0] for requirement in requirements)
    return {MODULES.get(name, name) for name in found}


def imported(tree):
    """The top-level names of all absolute imports below a node."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield (node.module or "").partition(".")[0]


def test_the_citation_has_the_version():
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited == [tt.__version__]


def test_the_changelog_starts_with_the_version_and_its_date():
    text = (ROOT / "CHANGELOG.md").read_text()
    heading = re.search(r"^## (\S+), (\S+)$", text, re.MULTILINE)
    assert heading is not None
    assert heading[1] == tt.__version__
    assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", heading[2])


def test_the_wheel_holds_the_environment_alone_under_its_version():
    targets = SETTINGS["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"] == {"packages": ["trap_tube_jax"]}
    assert SETTINGS["tool"]["hatch"]["version"] == {"path": "trap_tube_jax/_version.py"}


def test_the_environment_imports_what_the_wheel_installs_and_its_extras():
    project = SETTINGS["project"]
    extras = project["optional-dependencies"]
    required = names(project["dependencies"])
    optional = names(extras["pictures"] + extras["interop"]) | {"curses"}
    for path in (ROOT / "trap_tube_jax").rglob("*.py"):
        used = set(imported(ast.parse(path.read_text()))) - {"trap_tube_jax"}
        assert used <= required | optional | sys.stdlib_module_names, path
    assert required == {"jax", "flax", "chex", "numpy", "scipy"}
