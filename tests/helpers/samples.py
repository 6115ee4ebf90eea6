"""Many draws of a transfer, and what they are: counted, and told apart by board."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

import helpers.spec_reference as spec
import trap_tube_jax as tt

SAMPLES = 2**17
OUTLINES = list(spec.outlines())
BOARDS = np.array([list(spec.boards(outline)) for outline in OUTLINES])  # [9, 8, 12, 12]


@functools.cache
def batched(transfer: tt.Transfer) -> Callable[[jax.Array, tt.State], tt.State]:
    """`transfer` of one state under many keys."""
    return jax.jit(jax.vmap(transfer, (0, None)))


def draw(transfer: tt.Transfer, seed: int, state: tt.State, number: int = SAMPLES) -> Any:
    """A state of NumPy arrays [number, ...]."""
    keys = jax.random.split(jax.random.key(seed), number)
    return jax.tree.map(np.asarray, batched(transfer)(keys, state))


def flat(cells: np.ndarray) -> np.ndarray:
    return cells[..., 0] * 12 + cells[..., 1]


def tally(shape: tuple[int, ...], *indices: np.ndarray) -> np.ndarray:
    """Counts how often each tuple of indices occurs."""
    flat = np.ravel_multi_index(indices, shape)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)


def find_boards(boards: np.ndarray) -> np.ndarray:
    """Returns the indices of boards among the 72 possible ones; -1 for any other board."""
    weights = np.random.default_rng(0).integers(1, 2**40, 144)
    known = BOARDS.reshape(-1, 144).astype(np.int64) @ weights
    order = np.argsort(known)
    marks = boards.reshape(-1, 144).astype(np.int64) @ weights
    index = order[np.searchsorted(known[order], marks).clip(max=len(known) - 1)]
    same = np.all(BOARDS.reshape(-1, 12, 12)[index] == boards, axis=(1, 2))
    return np.where(same, index, -1)


class Layout(NamedTuple):
    """Returns the choices i64[n] of perceptual draws; cells are flat indices."""

    outline: np.ndarray
    variant: np.ndarray
    vertical: np.ndarray
    tool: np.ndarray
    agent: np.ndarray
    food: np.ndarray


def read_layouts(drawn: Any) -> Layout:
    """Reads drawn states; their tools are as long as the side that they run along."""
    index = find_boards(drawn.board)
    assert np.all(index >= 0), "a board that environment.md does not allow"
    outline, variant = np.divmod(index, 8)
    vertical = (drawn.tool_extent[:, 0] > 1).astype(int)
    height, width = np.array(OUTLINES)[outline, :2].T
    expected = np.where(vertical, [height, np.ones_like(width)], [np.ones_like(height), width])
    np.testing.assert_array_equal(drawn.tool_extent, expected.T)
    return Layout(outline, variant, vertical, *map(flat, (drawn.tool, drawn.agent, drawn.food)))
