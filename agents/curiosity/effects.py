"""Effects: the reward of an episode's first changes to food and tool, and of its first grasps.

Source: this project. Relatives: visits counted within an episode, in NGU (Badia et al., 2020) and
NovelD (Zhang et al., 2021); change as a reward, in C-BET (Parisi et al., 2021); the impact of
actions, in RIDE (Raileanu and Rocktaeschel, 2020).
"""

import jax
import jax.numpy as jnp
import numpy as np

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.curiosity.first_visits import first_visits
from agents.networks.hashing import hash_rows
from trap_tube_jax.geometry import cell_index
from trap_tube_jax.objects import BOARD_SIZE, DIRECTIONS

NUM_KINDS = 3
MIN_RATE = 1e-4  # effects per step; effects of a lower rate do not pay more


class Effects(Curiosity):
    """reward_t = sum over kinds k of new_k(o_0, a_0, ..., a_t, o_{t+1}) / rate_k.

    `new_effects` computes `new` for three kinds: the food enters a cell that is new to it in the
    episode, the tool enters one, and the agent grasps at a new colour. Each kind pays
    the inverse of its rate, a moving average of its effects per step. So all kinds pay the same in
    total, a rare effect pays more, and a kind pays less as the agent learns it. The decay of this
    average is `reward_ema_decay`.
    """

    def __init__(self, config: Config):
        self._decay = config.reward_ema_decay

    def memory(self) -> jax.Array:
        """Returns the first rates, f32[3]; a rate of 0 takes its first positive value at once."""
        return jnp.zeros(NUM_KINDS, jnp.float32)

    def reward(
        self, params: Params, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the reward of every step's new effects, and the rates."""
        mask = experience.episodes.mask
        new = new_effects(experience.episodes) * mask[None]
        rate = jnp.sum(new, axis=(1, 2)) / jnp.sum(mask)
        rate = jnp.where(memory > 0, self._decay * memory + (1 - self._decay) * rate, rate)
        return jnp.tensordot(1 / jnp.maximum(rate, MIN_RATE), new, axes=1), rate


def new_effects(episodes: Episodes) -> jax.Array:
    """Returns f32[3, B, T], 1 where a step has an effect that is new to the episode.

    Food and tool: the object moves to a cell where it has not been. Only agent, food and tool move.
    So the tool's cell is new exactly where the board without agent and food looks new in the
    episode, unless the tool has the colour of the cells that it covers.

    Grasp: the grasped cell has a colour that the episode has not grasped before.
    """
    new_cells = [first_visits(cell_index(cells))[:, 1:] for cells in (episodes.food, episodes.tool)]
    hand = episodes.agent[:, :-1].astype(jnp.int32)
    hand = hand + jnp.asarray(DIRECTIONS)[episodes.action[..., 0]]
    on_board = jnp.all((hand >= 0) & (hand < BOARD_SIZE), axis=-1)
    hand = jnp.clip(hand, 0, BOARD_SIZE - 1)  # off the board, the agent's cell
    episode, time = np.indices(hand.shape[:2], np.int32)
    color = hash_rows(episodes.observations()[episode, time, hand[..., 0], hand[..., 1]])
    return jnp.stack([*new_cells, jnp.where(on_board, first_visits(color), 0.0)])
