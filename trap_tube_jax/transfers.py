"""The transfers: PRNG-driven maps from states to states, and their composition.

A transfer is any pure function `(key, state) -> state`. The paper has three: `perceptual`
resamples the layout, `structural` the features, and `symbolic` swaps the roles of the tool and
another object.

Source: paper, sections "Perceptual", "Structural" and "Symbolic"; environment.md, "Transfers".
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.geometry import bar_cells, bar_covers, cell_of
from trap_tube_jax.layouts import LayoutTables, layout_tables
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    EXIT,
    FOOD,
    GROUND,
    MAX_TOOL_LENGTH,
    NUM_OBJECTS,
    TOOL,
    TRAP,
    TUBE1,
    TUBE2,
)
from trap_tube_jax.prng import threefry_key
from trap_tube_jax.state import State, check_state, with_narrow_integers

Transfer = Callable[[jax.Array, State], State]

SYMBOLIC_OBJECTS = np.array([TOOL, TUBE1, TUBE2, TRAP, EXIT], np.int32)
# Row of the resampled features per object code; agent and food take none.
POINT_OF_OBJECT = np.array([4, 2, 3, 1, 1, 0, 0, 0], np.int32)


def compose(*transfers: Transfer) -> Transfer:
    """Returns the transfer that applies `transfers` from left to right, with different keys.

    Transfer i gets the typed key `jax.random.fold_in(key, i)`: a Threefry key even if `key` is one
    of `rbg`, whose draws would depend on the batch (`threefry_key`).

    Raises:
      ValueError: a transfer is not callable, or not hashable.

    Example:
      >>> transfer = tt.compose(tt.perceptual, tt.symbolic)
      >>> state = transfer(jax.random.key(0), tt.base_state())
      >>> state.tool.tolist(), state.tool_extent.tolist()
      ([4, 4], [3, 1])
    """
    return Composition(transfers)


@dataclasses.dataclass(frozen=True)
class Composition:
    """Several transfers as one; see `compose`."""

    transfers: tuple[Transfer, ...]

    def __post_init__(self):
        for transfer in self.transfers:
            if not callable(transfer):
                raise ValueError(
                    f"a transfer is a function (key, state) -> state, got {transfer!r}; "
                    "allowed: trap_tube_jax.perceptual, structural, symbolic or a function of yours"
                )
            try:
                hash(transfer)
            except TypeError as error:
                raise ValueError(
                    f"a transfer must be hashable, for example a frozen dataclass, got {transfer!r}"
                ) from error

    def __call__(self, key: jax.Array, state: State) -> State:
        """Applies the transfers to `state`."""
        key = threefry_key(key)
        for index, transfer in enumerate(self.transfers):
            state = with_narrow_integers(transfer(jax.random.fold_in(key, index), state))
            # Without the barrier XLA fuses a draw into all of its uses and repeats it there.
            state = jax.lax.optimization_barrier(state)
        return state

    @property
    def __name__(self) -> str:
        names = ", ".join(map(transfer_name, self.transfers))
        return f"({names})" if len(self.transfers) > 1 else names or "identity"


@dataclasses.dataclass(frozen=True)
class Mixture:
    """The transfer that applies one of `transfers`, drawn with odds `weights`.

    Attributes:
      transfers: the transfers to choose from.
      weights: positive integers, one per transfer.
    """

    transfers: tuple[Transfer, ...]
    weights: tuple[int, ...]

    def __call__(self, key: jax.Array, state: State) -> State:
        """Applies the drawn transfer to `state`."""
        choice_key, transfer_key = jax.random.split(threefry_key(key))
        ticket = jax.random.randint(choice_key, (), 0, sum(self.weights), jnp.int32)
        tickets = np.repeat(np.arange(len(self.weights), dtype=np.int32), self.weights)
        # Under vmap all branches run and read their operands, which a key may be only once.
        words = jax.random.key_data(transfer_key)
        impl = jax.random.key_impl(transfer_key)

        def branch(transfer: Transfer) -> Callable[[jax.Array, State], State]:
            # Compositions return the same types, whatever the transfers do.
            apply = compose(transfer)
            return lambda words, state: apply(jax.random.wrap_key_data(words, impl=impl), state)

        branches = [branch(transfer) for transfer in self.transfers]
        return jax.lax.switch(jnp.asarray(tickets)[ticket], branches, words, state)

    @property
    def __name__(self) -> str:
        return " + ".join(map(transfer_name, self.transfers))


def parts_of(transfers: Iterable[Transfer]) -> set[Transfer]:
    """Returns the transfers themselves, in place of compositions and mixtures of them."""
    parts = set()
    for transfer in transfers:
        if isinstance(transfer, Composition | Mixture):
            parts |= parts_of(transfer.transfers)
        else:
            parts.add(transfer)
    return parts


def transfer_name(transfer: Transfer) -> str:
    """Returns the name of a transfer for labels and messages."""
    return getattr(transfer, "__name__", None) or repr(transfer)


def perceptual(key: jax.Array, state: State) -> State:
    """Resamples tube, openings, food, tool and agent; keeps the palette (F_P).

    Draws a number below n as the remainder of 32 random bits, whose distribution differs from
    the uniform one by less than n / 2**32. `layouts` lists the outcomes.
    Source: environment.md, "Perceptual".

    Args:
      key: PRNG key.
      state: one unbatched state; only its palette, time and flags are kept.

    Returns:
      A state with a new layout.

    Raises:
      ValueError: `key` is not one PRNG key, or `state` not one unbatched state.

    Example:
      >>> state = tt.perceptual(jax.random.key(0), tt.base_state())
      >>> state.agent.tolist()  # of the base task: [9, 1]
      [3, 11]
    """
    return draw_layout(key, state, layout_tables())


def draw_layout(key: jax.Array, state: State, layouts: LayoutTables) -> State:
    """Replaces the layout of `state` with one drawn from `layouts`; see `perceptual`."""
    check_state(state)
    tables = jax.tree.map(jnp.asarray, layouts)
    layout, food, tool, agent = jax.random.bits(threefry_key(key), (4,), jnp.uint32)
    outline, assignment = tables.layout[layout % len(tables.layout)]
    food %= tables.num_food[outline]
    tool %= tables.num_tools[outline]
    agent %= tables.num_agents[outline, tool]
    return state.replace(
        board=tables.board[outline, assignment].reshape(BOARD_SIZE, BOARD_SIZE),
        food=cell_of(tables.food[outline, food]),
        tool=cell_of(tables.tool[outline, tool]),
        tool_extent=tables.extent[outline],
        agent=cell_of(tables.agent[outline, tool, agent]),
    )


def structural(key: jax.Array, state: State) -> State:
    """Resamples the features of tool, tubes, trap, exit and ground (F_St).

    Draws five independent points u, uniform on the unit sphere in the palette's N dimensions,
    and sets features to floor((u + 1) / 2 * 255). Both tubes share a point; agent and food keep
    their features. Source: environment.md, "Structural".

    Args:
      key: PRNG key.
      state: one unbatched state.

    Returns:
      The state with a new palette.

    Raises:
      ValueError: `key` is not one PRNG key, or `state` not one unbatched state.

    Example:
      >>> state = tt.structural(jax.random.key(0), tt.base_state())
      >>> state.palette[0].tolist()  # the ground was [72, 65, 17]
      [161, 142, 249]
    """
    check_state(state)
    return recolor(state, sphere_points(key, state.palette.shape[-1]))


def sphere_points(key: jax.Array, num_features: int) -> jax.Array:
    """Draws the points f32[8, N] of `structural`, one per object code.

    Points are uniform on the unit sphere. The rows of agent and food are not used.
    """
    normal = jax.random.normal(threefry_key(key), (5, num_features), jnp.float32)
    points = normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)
    if num_features == 1:  # -1 and 1, which the rounded quotient may miss
        points = jnp.where(normal < 0, -1, 1).astype(jnp.float32)
    return points[POINT_OF_OBJECT]


def recolor(state: State, points: jax.Array) -> State:
    """Sets the features of all objects except agent and food by points f32[8, N].

    Coordinates are clipped to -1 to 1.
    """
    features = jnp.floor((points.clip(-1, 1) + 1) / 2 * 255).astype(jnp.uint8)
    keeps = np.isin(np.arange(NUM_OBJECTS), (AGENT, FOOD))[:, None]
    return state.replace(palette=jnp.where(keeps, state.palette, features))


def symbolic(key: jax.Array, state: State) -> State:
    """Swaps the roles and the colours of the tool and a random object (F_Sy).

    The object is uniform over tool, tube1, tube2, trap and exit; "tool" changes nothing. The
    new tool starts at the object's top-left cell, has as many cells, and is horizontal if the
    first two in reading order share a row. The object takes the old tool's cells.

    On custom boards, the state stays as it is if the object is not a bar of one to four cells, or
    if the tool covers agent or food, which would then stand on the object.
    Source: environment.md, "Symbolic".

    Args:
      key: PRNG key.
      state: one unbatched state.

    Returns:
      The state after the swap.

    Raises:
      ValueError: `key` is not one PRNG key, or `state` not one unbatched state.

    Example:
      >>> state = tt.symbolic(jax.random.key(1), tt.base_state())
      >>> state.tool.tolist(), state.tool_extent.tolist()  # a wall of the tube
      ([4, 4], [1, 4])
    """
    check_state(state)
    choice = jax.random.randint(threefry_key(key), (), 0, len(SYMBOLIC_OBJECTS), jnp.int32)
    return swap_with_tool(state, jnp.asarray(SYMBOLIC_OBJECTS)[choice])


def swap_with_tool(state: State, code: jax.Array) -> State:
    """Swaps the roles of the tool and a given object.

    Args:
      state: one unbatched state.
      code: integer[], one of `SYMBOLIC_OBJECTS`; the tool's code changes nothing.

    Returns:
      The state after the swap, or as it was; see `symbolic`.
    """
    code = code.astype(jnp.uint8)
    cells = np.arange(BOARD_SIZE**2, dtype=np.int32)
    is_object = state.board.reshape(-1) == code
    length = jnp.sum(is_object, dtype=jnp.int32)
    first = jnp.min(cells, where=is_object, initial=cells[-1])
    second = jnp.min(cells, where=is_object & (cells > first), initial=cells[-1])
    corner = cell_of(first)
    horizontal = (length > 1) & (second // BOARD_SIZE == first // BOARD_SIZE)
    extent = jnp.stack([jnp.where(horizontal, 1, length), jnp.where(horizontal, length, 1)])

    covers = functools.partial(bar_covers, state.tool, state.tool_extent)
    is_clear = ~covers(state.agent) & ~covers(state.food)
    is_bar = jnp.all(bar_cells(corner, extent).reshape(-1) == is_object)
    swaps = (length >= 1) & (length <= MAX_TOOL_LENGTH) & is_bar & is_clear
    old_tool = bar_cells(state.tool, state.tool_extent)
    board = jnp.where(state.board == code, jnp.uint8(GROUND), state.board)
    board = jnp.where(old_tool, code, board)
    objects = np.arange(NUM_OBJECTS, dtype=np.uint8)
    partner = jnp.where(objects == TOOL, code, jnp.where(objects == code, TOOL, objects))
    role = jnp.where(swaps, partner, objects)
    return state.replace(
        board=jnp.where(swaps, board, state.board),
        palette=jnp.asarray(state.palette)[role],  # NumPy takes no traced indices
        tool=jnp.where(swaps, corner, state.tool),
        tool_extent=jnp.where(swaps, extent, state.tool_extent),
    )
