"""Every Python block of the README and of the pages for users runs, one after the other."""

import re
from pathlib import Path

import numpy as np
import pytest

import trap_tube_jax as tt
from agents.experiments import statistics
from agents.experiments.records import read_record
from agents.experiments.tables import LABELS, PAPER_PERCENT
from trap_tube_jax.scoring.tasks import ALL_SETS

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PROTOCOL = ROOT / "trap_tube_jax" / "protocol.md"


def blocks_of(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


BLOCKS = blocks_of(README)
OTHER_LIBRARIES = blocks_of(ROOT / "trap_tube_jax" / "adapters" / "README.md")


def test_blocks_share_a_session(capsys):
    """As a reader would paste them, from top to bottom."""
    session: dict[str, object] = {}
    assert len(BLOCKS) >= 5
    for block in BLOCKS:
        exec(compile(block, str(README), "exec"), session)
    output = capsys.readouterr().out.splitlines()
    assert (output[1], output[-1]) == ("11", "21 1.0")


def test_own_tasks(own_task_sets):
    session: dict[str, object] = {}
    for block in blocks_of(ROOT / "trap_tube_jax" / "own_tasks.md"):
        exec(compile(block, "own_tasks.md", "exec"), session)
    assert "timestep" in session


@pytest.mark.parametrize("page", ["graded.md", "controls.md"])
def test_short_examples(page):
    for block in blocks_of(ROOT / "trap_tube_jax" / page):
        exec(compile(block, page, "exec"), {"tt": tt})


def test_the_protocol(capsys):
    session: dict[str, object] = {}
    for block in blocks_of(PROTOCOL):
        exec(compile(block, "protocol.md", "exec"), session)
    output = capsys.readouterr().out
    assert re.search(r"^\| base +\| +1 \| +0 \|", output, re.MULTILINE)
    assert re.search(r"^\| \{P, St, Sy\} +\| +100 \|", output, re.MULTILINE)


@pytest.mark.parametrize(("agent", "name"), [("fast", "fast_base"), ("best", "exp2_best")])
def test_the_leaderboard_is_of_the_records(agent, name):
    record = read_record(ROOT / "benchmarks" / "results" / f"{name}.json")
    (entry,) = record["algorithms"]
    summaries = statistics.by_set(record, entry).values()
    means = [f"{summary.percent.mean:.1f}" for summary in summaries if summary.percent]
    (row,) = re.findall(rf"^\| `{agent}`.*?\| (.*) \|$", PROTOCOL.read_text(), re.MULTILINE)
    steps = np.mean([run["transitions"] for run in entry["runs"]])
    assert row.split(" | ") == [*means, "1,000", f"{steps:,.0f}"]
    assert record["command"] in " ".join(PROTOCOL.read_text().split())


def test_the_leaderboard_has_the_papers_numbers():
    for name, spreads in PAPER_PERCENT.items():
        means = " | ".join(f"{spreads[each].mean:.1f}" for each in ALL_SETS if each != "base")
        assert f"| {LABELS[name]} of the paper, mean of 5 seeds [4] | – | {means} | 128 |" in (
            PROTOCOL.read_text()
        )


@pytest.mark.interop
@pytest.mark.parametrize("block", OTHER_LIBRARIES)
def test_blocks_of_other_libraries(block, own_task_sets):
    exec(compile(block, "adapters", "exec"), {})
