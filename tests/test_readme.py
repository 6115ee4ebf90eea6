"""Every Python block of the README runs, one after the other."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", README.read_text(), re.DOTALL | re.MULTILINE)
INTEROP = ("gymnasium", "to_gymnax")


def of_other_libraries(block: str) -> bool:
    return any(name in block for name in INTEROP)


def test_blocks_share_a_session(capsys):
    """As a reader would paste them, from top to bottom."""
    session: dict[str, object] = {}
    plain = [block for block in BLOCKS if not of_other_libraries(block)]
    assert len(plain) >= 5
    for block in plain:
        exec(compile(block, str(README), "exec"), session)
    assert capsys.readouterr().out.splitlines()[1] == "11"


@pytest.mark.interop
@pytest.mark.parametrize("block", [block for block in BLOCKS if of_other_libraries(block)])
def test_blocks_of_other_libraries(block):
    exec(compile(block, str(README), "exec"), {})
