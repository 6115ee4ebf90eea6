"""Episodes, as one scan over time.

Source: paper, section "Experimental Setup".
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.encodings import Cache
from agents.acting.episodes import Episodes, cells_of
from agents.acting.identity import layout_ids
from agents.networks.actions import ActionDistribution
from agents.networks.agent import Agent, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.state import State

ChooseAction = Callable[[jax.Array, ActionDistribution], jax.Array]


class Trajectory(NamedTuple):
    """Episodes and what the network made of them, under the parameters that acted.

    Attributes:
      episodes: B episodes of T steps.
      features: f32[T + 1, B, F], the encoded observations.
      embedding: f32[T, B, hidden], the GRU's outputs.
      log_prob: f32[T, B], of the actions.
      value: f32[T + 1, B, V], of every observation, the last one included, for each stream.
    """

    episodes: Episodes
    features: jax.Array
    embedding: jax.Array
    log_prob: jax.Array
    value: jax.Array


class _Carry(NamedTuple):
    """What one step of the scan hands to the next; `_tm1` is of the step before."""

    state: State
    embedding: jax.Array
    action_tm1: jax.Array
    reward_tm1: jax.Array
    cache: Cache


def sample_action(key: jax.Array, actions: ActionDistribution) -> jax.Array:
    """Draws actions i32[B, 2]."""
    return actions.sample(key)


def greedy_action(key: jax.Array, actions: ActionDistribution) -> jax.Array:
    """The most probable actions i32[B, 2]; the key is not used."""
    return actions.mode()


def rollout(
    agent: Agent,
    params: Params,
    env: Environment,
    initial: State,
    key: jax.Array,
    *,
    choose: ChooseAction,
) -> Trajectory:
    """Plays one episode from each of B initial states.

    Args:
      agent: the network.
      params: its parameters.
      env: the dynamics; `max_steps` is T.
      initial: B states at time 0.
      key: PRNG key of the actions.
      choose: `sample_action` or `greedy_action`.
    """

    def step(carry: _Carry, inputs: tuple[jax.Array, jax.Array]) -> tuple[_Carry, dict]:
        time, step_key = inputs
        before, embedding, action_tm1, reward_tm1, cache = carry
        features, cache = cache.encode(agent, params, before, time)
        embedding = agent.step(params, embedding, features, action_tm1, reward_tm1)
        actions, value = agent.policy_and_value(params, embedding)
        action = choose(step_key, actions)
        after, timestep = jax.vmap(env.step)(before, action)
        record = {
            "cells": cells_of(before),
            "action": action,
            "reward": timestep.reward,
            "discount": timestep.discount,
            "mask": 1.0 - (before.terminated | before.truncated),
            "embedding": embedding,
            "log_prob": actions.log_prob(action),
            "value": value,
        }
        return _Carry(after, embedding, action, timestep.reward, cache), record

    # Once more than there are steps, for the last observation; by then no state changes any more.
    times = jnp.arange(env.max_steps + 1)
    keys = jax.random.split(key, len(times))
    end, record = jax.lax.scan(step, _first(agent, params, env, initial), (times, keys))
    taken = {name: record[name][:-1] for name in ("action", "reward", "discount", "mask")}
    return Trajectory(
        episodes=Episodes(layout=initial, cells=record["cells"], **taken),
        features=end.cache.features,
        embedding=record["embedding"][:-1],
        log_prob=record["log_prob"][:-1],
        value=record["value"],
    )


def _first(agent: Agent, params: Params, env: Environment, initial: State) -> _Carry:
    """Before the first step: no action, no reward, nothing encoded."""
    batch = len(initial.time)
    return _Carry(
        state=initial,
        embedding=agent.initial_state(params, batch),
        action_tm1=jnp.zeros((batch, 2), jnp.int32),
        reward_tm1=jnp.zeros(batch),
        cache=Cache.empty(layout_ids(initial), env.max_steps, agent.width),
    )
