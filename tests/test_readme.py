"""Every Python block of the README and of the pages for users runs, one after the other."""

import re
from pathlib import Path

import pytest

from trap_tube_jax import registry

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"


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
    assert capsys.readouterr().out.splitlines()[1] == "11"


def test_own_tasks(monkeypatch):
    monkeypatch.setattr(registry, "_task_sets", dict(registry._task_sets))
    session: dict[str, object] = {}
    for block in blocks_of(ROOT / "trap_tube_jax" / "own_tasks.md"):
        exec(compile(block, "own_tasks.md", "exec"), session)
    assert "timestep" in session


@pytest.mark.interop
@pytest.mark.parametrize("block", OTHER_LIBRARIES)
def test_blocks_of_other_libraries(block):
    exec(compile(block, "adapters", "exec"), {})
