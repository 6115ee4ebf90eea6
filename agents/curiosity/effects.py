"""Effects: what the agent brings about, or meets, for the first time in an episode.

Source: own. Relatives: visits counted within an episode, in NGU (Badia et al., 2020) and NovelD
(Zhang et al., 2021); change as a reward, in C-BET (Parisi et al., 2021); the impact of actions,
in RIDE (Raileanu and Rocktaeschel, 2020).
"""

import jax
import jax.numpy as jnp
import numpy as np

from agents.acting.episodes import CELL_AGENT, CELL_FOOD, CELL_TOOL, Episodes
from agents.acting.identity import first_visits
from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks.grouping import hash_rows
from trap_tube_jax.objects import BOARD_SIZE, DIRECTIONS

NUM_KINDS = 3
OFF_BOARD = np.uint32(2**32 - 1)  # in place of the hash of a look; 0 is that of black
LOWEST_RATE = 1e-4  # effects a step, below which an effect does not pay more


class Effects(Curiosity):
    """reward_t = sum over kinds k of new_k(o_0, a_0, ..., a_t, o_{t+1}) / rate_k.

    `new` is a function of one episode's observations and actions (`new_effects`). There are three
    kinds of effects: on the food, on anything else but the agent's body, and on the hand. Each
    pays the inverse of its rate, a moving mean of how often it happens in a step. So all kinds
    pay the same in total, a rare one more each time, and one that the agent learns to bring about
    ever less.

    It assumes that the agent knows its own colour and the food's, which no transfer changes.

    Args:
      config: the settings, of which `reward_ema_decay` counts.
    """

    def __init__(self, config: Config):
        self._keep = config.reward_ema_decay

    def memory(self) -> jax.Array:
        """The rates f32[3]; each is 0 until it is first above 0, and is then taken as it is."""
        return jnp.zeros(NUM_KINDS)

    def reward(
        self, params: Params, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """What the new effects of every step pay, and the rates with this iteration's."""
        mask = experience.episodes.mask
        new = new_effects(experience.episodes) * mask[None]
        rate = jnp.sum(new, axis=(1, 2)) / jnp.sum(mask)
        rate = jnp.where(memory > 0, self._keep * memory + (1 - self._keep) * rate, rate)
        return jnp.tensordot(1 / jnp.maximum(rate, LOWEST_RATE), new, axes=1), rate


def new_effects(episodes: Episodes) -> jax.Array:
    """f32[3, T, B]: 1 where a step brings about something that is new to the episode.

    Food and tool: it comes to a cell where it has not been. The tool is all that moves beside
    agent and food. So its cell is new exactly where the board without these two looks as it has
    not looked before in the episode. A tool that has the colour of what it moves over is the
    exception: its moves pay and are not seen.

    Hand: the grasp is at something, or at ground, of a look that the hand has not met.
    """
    cell = episodes.cells.astype(jnp.int32)
    cell = cell[..., 0] * BOARD_SIZE + cell[..., 1]
    moved = [first_visits(cell[..., thing])[1:] for thing in (CELL_FOOD, CELL_TOOL)]
    return jnp.stack([*moved, new_touches(episodes)])


def new_touches(episodes: Episodes) -> jax.Array:
    """f32[T, B]: 1 where the cell that is grasped at shows a look new to the episode's grasps."""
    hand = episodes.cells[:-1, :, CELL_AGENT].astype(jnp.int32)
    hand = hand + jnp.asarray(DIRECTIONS)[episodes.action[..., 0]]
    on_board = jnp.all((hand >= 0) & (hand < BOARD_SIZE), axis=-1)
    hand = jnp.clip(hand, 0, BOARD_SIZE - 1)
    time, episode = jnp.indices(hand.shape[:2])
    look = episodes.observations()[time, episode, hand[..., 0], hand[..., 1]]
    return first_visits(jnp.where(on_board, hash_rows(look), OFF_BOARD)) * on_board
