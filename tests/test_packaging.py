"""One version, in every place that names it."""

import importlib
import pathlib
import re
import tomllib

import trap_tube_jax as tt

ROOT = pathlib.Path(__file__).parent.parent


def test_the_distribution_has_the_version_of_the_package():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in settings["project"]["dynamic"]
    module, _, name = settings["tool"]["setuptools"]["dynamic"]["version"]["attr"].rpartition(".")
    assert getattr(importlib.import_module(module), name) == tt.__version__


def test_the_citation_has_the_version():
    cited = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited == [tt.__version__]


def test_the_changelog_starts_with_the_version_and_its_date():
    text = (ROOT / "CHANGELOG.md").read_text()
    heading = re.search(r"^## (\S+), (\S+)$", text, re.MULTILINE)
    assert heading is not None
    assert heading[1] == tt.__version__
    assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", heading[2])
