"""Episodes, as one scan over time.

Source: paper, section "Experimental Setup".
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.encodings import Cache
from agents.acting.episodes import Episodes, cells_of
from agents.acting.identity import layout_ids
from agents.networks.agent import Agent, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.state import State


class Trajectory(NamedTuple):
    """Episodes and the network's outputs, under the parameters that acted.

    Attributes:
      episodes: B episodes of T steps.
      features: f32[T + 1, B, F], the encoded observations.
      embedding: f32[T, B, hidden], the GRU's outputs.
      log_prob: f32[T, B], of the actions.
      value: f32[T + 1, B, V], of every observation, the last one included, by value head.
    """

    episodes: Episodes
    features: jax.Array
    embedding: jax.Array
    log_prob: jax.Array
    value: jax.Array


class _Carry(NamedTuple):
    state: State
    embedding: jax.Array
    action_tm1: jax.Array
    reward_tm1: jax.Array
    cache: Cache


def rollout(
    agent: Agent, params: Params, env: Environment, initial: State, key: jax.Array | None
) -> Trajectory:
    """Plays one episode from each of B initial states.

    Args:
      agent: the network.
      params: its parameters.
      env: the dynamics; `max_steps` is T.
      initial: B states at time 0.
      key: PRNG key of the actions; None takes the most probable ones.
    """

    def step(carry: _Carry, inputs: tuple[jax.Array, jax.Array | None]) -> tuple[_Carry, dict]:
        time, step_key = inputs
        before, embedding, action_tm1, reward_tm1, cache = carry
        features, cache = cache.encode(agent, params, before, time)
        embedding = agent.step(params, embedding, features, action_tm1, reward_tm1)
        actions, value = agent.policy_and_value(params, embedding)
        action = actions.mode() if step_key is None else actions.sample(step_key)
        after, timestep = jax.vmap(env.step)(before, action)
        record = {
            "cells": cells_of(before),
            "action": action,
            "reward": timestep.reward,
            "discount": timestep.discount,
            "mask": (~(before.terminated | before.truncated)).astype(jnp.float32),
            "embedding": embedding,
            "log_prob": actions.log_prob(action),
            "value": value,
        }
        return _Carry(after, embedding, action, timestep.reward, cache), record

    batch = len(initial.time)
    first = _Carry(
        state=initial,
        embedding=agent.initial_state(params, batch),
        action_tm1=jnp.zeros((batch, 2), jnp.int32),
        reward_tm1=jnp.zeros(batch, jnp.float32),
        cache=Cache.empty(layout_ids(initial), env.max_steps, agent.width),
    )
    # One more step than the episode has, for the last observation; states do not change any more.
    times = jnp.arange(env.max_steps + 1, dtype=jnp.int32)
    keys = None if key is None else jax.random.split(key, len(times))
    end, record = jax.lax.scan(step, first, (times, keys))
    taken = {name: record[name][:-1] for name in ("action", "reward", "discount", "mask")}
    return Trajectory(
        episodes=Episodes(layout=initial, cells=record["cells"], **taken),
        features=end.cache.features,
        embedding=record["embedding"][:-1],
        log_prob=record["log_prob"][:-1],
        value=record["value"],
    )
