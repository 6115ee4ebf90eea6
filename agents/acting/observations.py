"""Observations of whole episodes: which are the same, which are new, and their features."""

import jax
import jax.numpy as jnp

from agents.acting.rollout import Trajectory, place
from agents.config import Config
from agents.networks import distinct
from agents.networks.agent import Agent, Params
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State

VISIT_SLOTS = 2**20


def encode_episodes(
    params: Params,
    agent: Agent,
    config: Config,
    observation_id: jax.Array,
    layout: State,
    cells: jax.Array,
) -> jax.Array:
    """The features f32[T + 1, B, F] of episodes, each distinct observation encoded once.

    Args:
      params: the parameters.
      agent: the network.
      config: the settings.
      observation_id: i32[T + 1, B], equal only for equal observations.
      layout: B states.
      cells: u8[T + 1, B, 3, 2]; with the layouts, the observations.
    """
    shape = observation_id.shape
    groups = distinct.group(observation_id.reshape(-1))
    time, episode = groups.representative // shape[1], groups.representative % shape[1]
    rows = jax.vmap(lambda layout, cells: observe(place(layout, cells)))(
        jax.tree.map(lambda x: x[episode], layout), cells[time, episode]
    )
    features = distinct.map_rows(
        agent.encode_rows, config.chunk, agent.encoding_params(params), rows, groups.total
    )
    return features[groups.number].reshape(*shape, -1)


def observation_ids(layout: State, cells: jax.Array) -> jax.Array:
    """i32[T + 1, B]: equal only for equal observations, numbered from 0."""
    position = _position_ids(layout, cells)
    layout_id = jnp.broadcast_to(distinct.layout_ids(layout), position.shape)
    groups = distinct.group(layout_id.reshape(-1), position.reshape(-1))
    return groups.number.reshape(position.shape)


def visit_slots(trajectory: Trajectory) -> jax.Array:
    """i32[T + 1, B]: the slot of every observation in a table of `VISIT_SLOTS`."""
    position = _position_ids(trajectory.layout, trajectory.cells)
    code = distinct.layout_hash(trajectory.layout)[None] + position.astype(jnp.uint32)
    # The finaliser of MurmurHash3: every bit of the code moves every bit of the slot.
    code = (code ^ (code >> 16)) * jnp.uint32(0x85EBCA6B)
    code = (code ^ (code >> 13)) * jnp.uint32(0xC2B2AE35)
    return ((code ^ (code >> 16)) % VISIT_SLOTS).astype(jnp.int32)


def first_visits(observation_id: jax.Array) -> jax.Array:
    """f32[T + 1, B]: 1 where an observation is new in its episode, 0 where it returns."""
    time = jnp.arange(len(observation_id))
    same = observation_id[:, None] == observation_id[None]
    earlier = (time[:, None] > time[None])[..., None]
    return 1.0 - jnp.any(same & earlier, axis=1)


def _position_ids(layout: State, cells: jax.Array) -> jax.Array:
    """i32[T + 1, B]: the ids of where agent, tool and food are."""
    states = jax.vmap(jax.vmap(place), in_axes=(None, 0))(layout, cells)
    return jax.vmap(jax.vmap(distinct.position_id))(states)
