"""Pages for users: Python blocks run and print what they state; links and commands exist."""

import contextlib
import csv
import doctest
import functools
import importlib.util
import io
import re
import runpy
import shlex
import sys
from pathlib import Path
from statistics import fmean

import pytest

from agents import registry
from paths import ROOT
from trap_tube_jax.scoring.tasks import ALL_SETS

PAGES = [*ROOT.glob("*.md")]
for folder in ("trap_tube_jax", "agents", "benchmarks", "tests"):
    PAGES += ROOT.joinpath(folder).rglob("*.md")
NAMES = sorted(str(page.relative_to(ROOT)) for page in PAGES)
PROTOCOL = "trap_tube_jax/protocol.md"

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


@pytest.fixture
def _own_names(own_task_sets):
    kinds = (registry.curiosities, registry.encoders)
    known = [set(kind) for kind in kinds]
    yield
    for kind, names in zip(kinds, known, strict=True):
        for name in set(kind) - names:
            del kind[name]


@pytest.mark.usefixtures("_own_names")
@pytest.mark.parametrize(("code", "output"), blocks())
def test_a_block_runs_by_itself_and_prints_what_stands_under_it(
    code, output, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "block", "exec"), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert CHECKER.check_output(output, printed, options), f"printed:\n{printed}"


def anchors(path: Path) -> set[str]:
    """Returns the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", path.read_text()), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_to_files_and_headings(name):
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", page.read_text())):
        if not target.startswith(("http://", "https://")):
            file, _, anchor = target.partition("#")
            path = page.parent / file if file else page
            assert path.exists(), target
            assert not anchor or anchor in anchors(path), target


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_described(name):
    assert "![](" not in text_of(name)


def commands():
    """Returns the commands `python -m MODULE ...` of all pages, and where they stand."""
    found = {}
    for name in NAMES:
        text = text_of(name)
        shell = [body.replace("\\\n", " ") for kind, body in FENCE.findall(text) if kind == "bash"]
        lines = "\n".join(shell).splitlines()
        lines += [" ".join(code.split()) for code in INLINE.findall(FENCE.sub("", text))]
        for line in lines:
            for command in re.findall(
                r"python -m ((?:trap_tube_jax|agents|benchmarks)\S*.*)", line
            ):
                found[command.partition(" #")[0].strip()] = name
    return found


@functools.cache
def help_of(module: str, *rest: str) -> str:
    """Returns what a command prints with --help."""
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output):
        patch.setattr(sys, "argv", [module, *rest, "--help"])
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


def percent_solved(record: str) -> dict[str, dict[str, list[float]]]:
    """Returns the percentages of a record by algorithm and task set, a number per seed."""
    found: dict[str, dict[str, list[float]]] = {}
    with (ROOT / "benchmarks" / "results" / record / "results.csv").open() as file:
        for row in csv.DictReader(file):
            if row["purpose"] == "test":
                own = found.setdefault(row["algorithm"], {}).setdefault(row["task_set"], [])
                own.append(100 * int(row["solved"]) / int(row["tasks"]))
    return found


def cells(values: list[float]) -> str:
    return " | ".join(f"{value:.1f}" for value in values)


def test_stated_results_are_those_of_the_records():
    best, fast = percent_solved("exp2_best")["best"], percent_solved("fast_base")["fast"]
    means = {name: [fmean(own[each]) for each in ALL_SETS] for name, own in
             (("best", best), ("fast", fast))}  # fmt: skip
    for name, own in means.items():
        assert re.search(rf"`{name}`, mean .* {re.escape(cells(own))} ", text_of(PROTOCOL)), name
    (row,) = re.findall(r"^\| preset `best` \| (.*) \|$", text_of("README.md"), re.M)
    assert re.sub(r" \[[^]]*\]", "", row) == cells(means["best"][1:])
    page = text_of("benchmarks/results/best_preset.md")
    for seed in range(5):
        assert f"| {seed} | {cells([best[each][seed] for each in ALL_SETS[1:]])} |" in page
    page = text_of("benchmarks/results/curiosities.md")
    for name, own in percent_solved("exp2_curiosities").items():
        seeds = [", ".join(f"{value:.1f}" for value in own[each]) for each in ALL_SETS[1:]]
        assert f"| `{name}` | {' | '.join(seeds)} |" in page


def test_pages_stay_short():
    words = {name: len(text_of(name).split()) for name in NAMES}
    assert words["README.md"] <= 1500
    assert sum(words.values()) <= 14_000
