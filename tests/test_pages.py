"""Pages for users: Python blocks run and print what they state; links and commands exist."""

import contextlib
import dataclasses
import doctest
import functools
import importlib.util
import io
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from agents.config import Config
from helpers.jax_settings import HAS_DEFAULT_DRAWS
from helpers.paths import ROOT

PAGES = [*ROOT.glob("*.md")]
for folder in ("trap_tube_jax", "agents", "benchmarks", "tests"):
    PAGES += ROOT.joinpath(folder).rglob("*.md")
NAMES = sorted(str(page.relative_to(ROOT)) for page in PAGES)

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
BLOCK = re.compile(r"^```python\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?", re.DOTALL | re.MULTILINE)
OTHER_LIBRARIES = re.compile(r"^(?:import|from) (?:gymnasium|gymnax)\b|to_gymnax", re.MULTILINE)
INLINE = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"python -m ((?:trap_tube_jax|agents|benchmarks)\b.*)")
CHECKER = doctest.OutputChecker()


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks():
    """Returns the Python blocks: the page, the code, and what stands under it as its output."""
    found = []
    for name in NAMES:
        for number, (code, output) in enumerate(BLOCK.findall(text_of(name)), 1):
            comments = re.findall(r"^# ?(.*\n)", code, re.MULTILINE)
            marks = [pytest.mark.interop] if OTHER_LIBRARIES.search(code) else []
            found.append(
                pytest.param(code, output or "".join(comments), id=f"{name}-{number}", marks=marks)
            )
    return found


@pytest.mark.usefixtures("fresh_names")
@pytest.mark.parametrize(("code", "output"), blocks())
def test_a_block_runs_by_itself_and_prints_what_stands_under_it(
    code, output, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "block", "exec"), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    if HAS_DEFAULT_DRAWS:
        assert CHECKER.check_output(output, printed, options), f"printed:\n{printed}"


def anchors(path: Path) -> set[str]:
    """Returns the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", path.read_text()), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_to_files_and_headings_and_pictures_are_described(name):
    page = ROOT / name
    assert "![](" not in page.read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", page.read_text())):
        if not target.startswith(("http://", "https://")):
            file, _, anchor = target.partition("#")
            path = page.parent / file if file else page
            assert path.exists(), target
            assert not anchor or anchor in anchors(path), target


def test_sections_that_the_code_names_are_headings():
    pages = {page.name: page for page in PAGES if page.name != "README.md"}
    named = 0
    for folder in ("trap_tube_jax", "agents", "benchmarks"):
        for path in ROOT.joinpath(folder).rglob("*.py"):
            text = " ".join(path.read_text().split())
            for page, sections in re.findall(r'(\w+\.md), ((?:(?:, | and )?"[^"]+")+)', text):
                headings = re.findall(r"^#+ (.+)$", pages[page].read_text(), re.MULTILINE)
                assert set(re.findall('"([^"]+)"', sections)) <= set(headings), path
                named += 1
    assert named > 25


def commands():
    """Returns the commands `python -m MODULE ...` of all pages, and where they stand."""
    found = {}
    for name in NAMES:
        text = text_of(name)
        shell = [body.replace("\\\n", " ") for kind, body in FENCE.findall(text) if kind == "bash"]
        lines = "\n".join(shell).splitlines()
        lines += [" ".join(code.split()) for code in INLINE.findall(FENCE.sub("", text))]
        for line in lines:
            for command in COMMAND.findall(line):
                found[command.partition(" #")[0].strip()] = name
    return found


@functools.cache
def help_of(module: str, *rest: str) -> str:
    """Returns what a command prints with --help."""
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.setattr(sys, "argv", [module, *rest, "--help"])
        patch.setenv("COLUMNS", "80")
        with contextlib.suppress(SystemExit):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    return output.getvalue()


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("command", commands())
def test_commands_exist_with_their_options(command):
    module, *words = shlex.split(command)
    assert importlib.util.find_spec(module)
    options = [word.partition("=")[0] for word in words if word.startswith("--")]
    subcommand = words[:1] if module == "agents.experiments" else []
    if options or subcommand:
        known = help_of(module, *subcommand)
        assert known
        for option in set(options) - {"--help"}:
            assert re.search(rf"{re.escape(option)}\b", known), option


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
@pytest.mark.parametrize("module", sorted({command.split()[0] for command in commands()}))
def test_help_fits_80_columns_and_100_lines(module):
    if module.startswith(("agents.examples.rejax", "agents.examples.sb3")):
        pytest.skip("needs other libraries")
    shown = help_of(module)
    assert "usage:" in shown
    assert max(map(len, shown.splitlines())) < 80
    assert len(shown.splitlines()) <= 100


def test_agent_md_states_every_setting_that_a_preset_changes():
    table = text_of("agents/agent.md").split("| setting | `paper` | `fast` | `best` |\n")[1]
    stated = re.findall(r"^\| `(\w+)`[^|]*\| (.+) \| (.+) \| (.+) \|$", table, re.MULTILINE)
    presets = [Config.preset(name) for name in ("paper", "fast", "best")]
    values = [
        (field.name, *(str(getattr(preset, field.name)) for preset in presets))
        for field in dataclasses.fields(Config)
    ]
    assert stated == [row for row in values if len(set(row[1:])) > 1]


def test_pages_stay_short():
    words = {name: len(text_of(name).split()) for name in NAMES}
    assert words["README.md"] <= 1500
    assert sum(words.values()) <= 14_000
