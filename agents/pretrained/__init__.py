"""Trained agents that are shipped with the code, one safetensors file each.

fast-base   the preset `fast` on base: the median of ten seeds
icm-base    the preset `paper` on base, PPO + ICM
best-pstsy  the preset `best` on {P, St, Sy}: the median of five seeds
"""

from pathlib import Path

from agents.arrays import SUFFIX

FOLDER = Path(__file__).parent


def names() -> tuple[str, ...]:
    """Returns the names of the shipped agents."""
    return tuple(sorted(path.name.removesuffix(SUFFIX) for path in FOLDER.glob(f"*{SUFFIX}")))
