"""One step of acting, shared by rollouts and trained policies."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.repeats import Repeats
from agents.networks.agent import Agent, Params


class Memory(NamedTuple):
    """Memory of the agent between the steps of B episodes.

    Attributes:
      hidden: f32[B, H], the state of the GRU.
      action_tm1: i32[B, 2], the previous (grasp, move); zeros before the first step.
      reward_tm1: f32[B], the previous reward; 0 before the first step.
      repeats: the actions that greedy play has tried; None without `repeat_penalty`.
    """

    hidden: jax.Array
    action_tm1: jax.Array
    reward_tm1: jax.Array
    repeats: Repeats | None

    @staticmethod
    def empty(agent: Agent, params: Params, batch: int, *, greedy: bool) -> "Memory":
        """Returns the memory before the first step of `batch` episodes."""
        return Memory(
            hidden=agent.initial_state(params, batch),
            action_tm1=jnp.zeros((batch, 2), jnp.int32),
            reward_tm1=jnp.zeros(batch, jnp.float32),
            repeats=Repeats.empty(batch) if greedy and agent.config.repeat_penalty else None,
        )


class Choice(NamedTuple):
    """Actions of B episodes.

    Attributes:
      action: i32[B, 2], (grasp, move).
      log_prob: f32[B], of the action.
      value: f32[B, V], one value per head for the current observation.
    """

    action: jax.Array
    log_prob: jax.Array
    value: jax.Array


def choose(
    agent: Agent,
    params: Params,
    memory: Memory,
    features: jax.Array,
    observation: jax.Array,
    key: jax.Array | None,
) -> tuple[Choice, Memory]:
    """Chooses one action for each of B episodes.

    Args:
      agent: functions of the policy network.
      params: its parameters.
      memory: memory of the steps before.
      features: f32[B, F], the encoded observations.
      observation: u8[B, 12, 12, N]; only greedy play with `repeat_penalty` reads it.
      key: PRNG key of the draws; None takes the most probable actions after `repeat_penalty`.
    """
    hidden = agent.step(params, memory.hidden, features, memory.action_tm1, memory.reward_tm1)
    actions, value = agent.policy_and_value(params, hidden)
    repeats = memory.repeats
    if key is not None:
        action = actions.sample(key)
    elif repeats is None:
        action = actions.mode()
    else:
        action, repeats = repeats.choose(actions, agent.config.repeat_penalty, observation)
    choice = Choice(action, actions.log_prob(action), value)
    return choice, Memory(hidden, action, memory.reward_tm1, repeats)
