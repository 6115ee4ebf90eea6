"""A trained policy: pure functions from observations to actions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.frames import Frame
from agents.acting.repeats import Repeats
from agents.config import Config
from agents.networks.agent import Agent, Params
from trap_tube_jax.objects import BOARD_SIZE


class Carry(NamedTuple):
    """Memory of a policy between the steps of B episodes.

    Attributes:
      embedding: f32[B, hidden], the state of the GRU.
      action_tm1: i32[B, 2], the previous (grasp, move) in the frame; zeros before the first step.
      frame: the frames, three arrays bool[B], fixed by each episode's first observation.
      is_first: bool[B], true before the first step.
      repeats: what greedy play has tried; None without `repeat_penalty`.
    """

    embedding: jax.Array
    action_tm1: jax.Array
    frame: Frame
    is_first: jax.Array
    repeats: Repeats | None


class Policy(NamedTuple):
    """A trained network that acts from observations alone.

    Start every episode with `initial`. The network always gets a previous reward of 0, as in
    training until an episode ends.

    Attributes:
      name: the policy's name in tables.
      config: the settings of its training.
      params: its parameters.
      iteration: iterations trained.
      greedy: takes the most probable actions after `repeat_penalty`; otherwise draws them.
    """

    name: str
    config: Config
    params: Params
    iteration: int
    greedy: bool = True

    def initial(self, batch: int) -> Carry:
        """Returns the carry before the first step of `batch` episodes."""
        zeros = jnp.zeros(batch, jnp.int32)
        return Carry(
            embedding=Agent(self.config).initial_state(self.params, batch),
            action_tm1=jnp.zeros((batch, 2), jnp.int32),
            frame=Frame.of(zeros),
            is_first=zeros == 0,
            repeats=Repeats.empty(batch) if self.config.repeat_penalty else None,
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
          The actions i32[B, 2], (grasp, move) each, and the next carry.

        Raises:
          ValueError: shape or dtype of `observation` is wrong, or a key is missing.
        """
        wanted = (len(carry.action_tm1), BOARD_SIZE, BOARD_SIZE, self.config.num_features)
        if observation.shape != wanted or observation.dtype != jnp.uint8:
            raise ValueError(
                f"observation must be uint8{list(wanted)}, "
                f"got {observation.dtype}{list(observation.shape)}"
            )
        if key is None and not self.greedy:
            raise ValueError("a policy that draws its actions needs a key; greedy ones do not")
        agent, frame = Agent(self.config), carry.frame
        if self.config.align_to_food:
            first = jax.vmap(Frame.facing_food)(observation)
            frame = jax.tree.map(lambda x, y: jnp.where(carry.is_first, x, y), first, frame)
            observation = jax.vmap(Frame.picture)(frame, observation)
        features = agent.encode(self.params, observation)
        reward_tm1 = jnp.zeros(len(observation), jnp.float32)
        embedding = agent.step(self.params, carry.embedding, features, carry.action_tm1, reward_tm1)
        actions, _ = agent.policy_and_value(self.params, embedding)
        repeats = carry.repeats
        if key is not None and not self.greedy:
            action = actions.sample(key)
        elif repeats is None:
            action = actions.mode()
        else:
            penalty = self.config.repeat_penalty
            action, repeats = repeats.choose(actions, penalty, observation)
        after = Carry(embedding, action, frame, jnp.zeros_like(carry.is_first), repeats)
        return jax.vmap(Frame.original_action)(frame, action), after
