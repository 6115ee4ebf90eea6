"""A trained policy: pure functions from observations to actions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from agents.acting.step import Memory, choose
from agents.acting.symmetry import Symmetry
from agents.config import Config
from agents.networks.agent import Agent, Params
from trap_tube_jax.objects import BOARD_SIZE


class Carry(NamedTuple):
    """Memory of a policy between the steps of B episodes.

    Every array has B rows, so an episode can be reset by replacing its row with `initial`'s.

    Attributes:
      memory: memory of the agent, which acts on turned boards.
      symmetry: B symmetries that turn the boards, fixed by the first observation of an episode.
      is_first: bool[B], true before the first step.
    """

    memory: Memory
    symmetry: Symmetry
    is_first: jax.Array


class Policy(struct.PyTreeNode):
    """A trained network that acts from observations alone.

    Start every episode with `initial`. The previous-reward input is always 0, since only the last
    step pays. A policy is a pytree whose leaves are its parameters; to run several checkpoints
    by one compiled program, `replace` only `params`.

    Attributes:
      config: the settings of its training.
      params: its parameters.
      iteration: iterations trained.
      greedy: takes the most probable actions after `repeat_penalty`; otherwise draws them.

    Example:
      >>> policy = agents.load("fast-base")
      >>> observation = tt.observe(tt.base_state())[None]
      >>> action, carry = jax.jit(policy.act)(observation, policy.initial(1))
      >>> action.shape
      (1, 2)
    """

    config: Config = struct.field(pytree_node=False)
    params: Params
    iteration: int = struct.field(pytree_node=False)
    greedy: bool = struct.field(pytree_node=False, default=True)

    def initial(self, batch: int) -> Carry:
        """Returns the carry before the first step of `batch` episodes."""
        return Carry(
            memory=Memory.empty(Agent(self.config), self.params, batch, greedy=self.greedy),
            symmetry=Symmetry.from_index(jnp.zeros(batch, jnp.int32)),
            is_first=jnp.ones(batch, bool),
        )

    def act(
        self, observation: jax.Array, carry: Carry, key: jax.Array | None = None
    ) -> tuple[jax.Array, Carry]:
        """Chooses one action for each of B episodes. Pure; jit it.

        Args:
          observation: u8[B, 12, 12, N].
          carry: `initial(B)` at an episode's first step, then the carry of the last call.
          key: PRNG key of the draws; unused if `greedy`.

        Returns:
          The actions i32[B, 2], (grasp, move), and the next carry.

        Raises:
          ValueError: shape or dtype of `observation` is wrong, or a key is missing.
        """
        wanted = (len(carry.is_first), BOARD_SIZE, BOARD_SIZE, self.config.num_features)
        if observation.shape != wanted or observation.dtype != jnp.uint8:
            raise ValueError(
                f"observation must be uint8{list(wanted)}, "
                f"got {observation.dtype}{list(observation.shape)}"
            )
        if key is None and not self.greedy:
            raise ValueError("a policy that draws its actions needs a key; greedy ones do not")
        agent = Agent(self.config)
        symmetry = carry.symmetry
        if self.config.align_to_food:
            first = jax.vmap(Symmetry.facing_food)(observation)
            symmetry = jax.tree.map(lambda x, y: jnp.where(carry.is_first, x, y), first, symmetry)
            observation = jax.vmap(Symmetry.transform_board)(symmetry, observation)
        features = agent.encode(self.params, observation)
        step_key = None if self.greedy else key
        choice, memory = choose(agent, self.params, carry.memory, features, observation, step_key)
        action = jax.vmap(Symmetry.original_action)(symmetry, choice.action)
        return action, Carry(memory, symmetry, jnp.zeros_like(carry.is_first))
