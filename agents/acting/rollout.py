"""Episodes, as one scan over time.

Source: agent specification "PPO"; paper section "Experimental Setup".
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.networks import distinct
from agents.networks.agent import Agent, Params
from agents.networks.core import Outputs
from agents.parallel.sharding import Shards
from agents.ppo.losses import log_prob
from trap_tube_jax.environment import Environment
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State

SLOT_BITS = 20  # of an observation's hash, by which episodes remember what they met

ChooseAction = Callable[[jax.Array, Outputs], jax.Array]


class Trajectory(NamedTuple):
    """B episodes of T steps, padded after an early end with what does not change any more.

    Attributes:
      layout: B states, of which board, palette and tool extent hold for the episode.
      cells: u8[T + 1, B, 3, 2], the (row, column) of agent, tool and food.
      action: i32[T, B, 2], (grasp, move).
      reward: f32[T, B], extrinsic.
      mask: f32[T, B], 1 on steps taken before the episode's end.
      features: f32[T + 1, B, F], the observations as encoded by the acting parameters.
      log_prob: f32[T, B], of the actions, grasp plus move.
      value: f32[T, B].
      embedding: f32[T, B, hidden], the GRU's outputs.
    """

    layout: State
    cells: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array
    features: jax.Array
    log_prob: jax.Array
    value: jax.Array
    embedding: jax.Array

    @property
    def solved(self) -> jax.Array:
        """bool[B]: episodes that earned their reward."""
        return jnp.any(self.reward > 0, axis=0)

    @property
    def length(self) -> jax.Array:
        """i32[B]: steps taken."""
        return jnp.sum(self.mask, axis=0).astype(jnp.int32)

    def gathered(self, shards: Shards) -> "Trajectory":
        """The episodes of all devices; with several, without features and embeddings."""
        if shards.count == 1:
            return self
        light = self._replace(layout=None, features=None, embedding=None)
        return shards.whole(light, axis=1)._replace(layout=shards.whole(self.layout))

    def observations(self) -> jax.Array:
        """All boards, u8[T + 1, B, 12, 12, N]."""
        one_time = jax.vmap(lambda layout, cells: observe(place(layout, cells)))
        return jax.vmap(one_time, in_axes=(None, 0))(self.layout, self.cells)


class _Memory(NamedTuple):
    """What has been encoded so far.

    Attributes:
      position: i32[T + 1, B].
      features: f32[T + 1, B, F].
      newest: i32[S], by hash of an observation, where above (time * B + episode) it was last
        met; -1 where it never was. Of observations with the same hash, one is forgotten.
    """

    position: jax.Array
    features: jax.Array
    newest: jax.Array


class _Carry(NamedTuple):
    state: State
    embedding: jax.Array
    action_tm1: jax.Array
    reward_tm1: jax.Array
    memory: _Memory


def sample_action(key: jax.Array, outputs: Outputs) -> jax.Array:
    """Draws grasp and move i32[B, 2] independently from their logits."""
    grasp_key, move_key = jax.random.split(key)
    grasp = jax.random.categorical(grasp_key, outputs.grasp_logits)
    move = jax.random.categorical(move_key, outputs.move_logits)
    return jnp.stack([grasp, move], axis=-1).astype(jnp.int32)


def greedy_action(key: jax.Array, outputs: Outputs) -> jax.Array:
    """The most probable grasp and move i32[B, 2]; the key is not used."""
    del key
    choices = [jnp.argmax(outputs.grasp_logits, -1), jnp.argmax(outputs.move_logits, -1)]
    return jnp.stack(choices, axis=-1).astype(jnp.int32)


def place(layout: State, cells: jax.Array) -> State:
    """The state with agent, tool and food at `cells` u8[3, 2]."""
    agent, tool, food = cells.astype(jnp.int32)
    return layout.replace(agent=agent, tool=tool, food=food)


def rollout(
    agent: Agent,
    params: Params,
    env: Environment,
    initial: State,
    key: jax.Array,
    *,
    choose: ChooseAction,
    chunk: int,
) -> Trajectory:
    """Plays one episode from each of B initial states.

    Observations are encoded once each, whichever of the episodes meet them and when.

    Args:
      agent: the network.
      params: its parameters.
      env: the dynamics; `max_steps` is T.
      initial: B states at time 0.
      key: PRNG key of the actions.
      choose: `sample_action` or `greedy_action`.
      chunk: distinct observations encoded at once.
    """
    batch = initial.time.shape[0]
    layout_id = distinct.layout_ids(initial)

    def encode(state: State, memory: _Memory, time: jax.Array | int) -> tuple[jax.Array, _Memory]:
        position = jax.vmap(distinct.position_id)(state)
        slot = distinct.slots(jnp.stack([layout_id, position], axis=1), SLOT_BITS)
        met = memory.newest[slot]
        same_layout = layout_id[met % batch] == layout_id
        seen = (met >= 0) & same_layout & (memory.position.reshape(-1)[met] == position)
        recalled = memory.features.reshape(-1, memory.features.shape[-1])[met]
        groups = distinct.group(seen.astype(jnp.int32), layout_id, position)
        num_new = jnp.max(jnp.where(seen, -1, groups.number)) + 1
        rows = jax.vmap(observe)(state)[groups.representative]
        new = distinct.map_rows(
            agent.encode_rows, chunk, agent.encoding_params(params), rows, num_new
        )
        features = jnp.where(seen[:, None], recalled, new[groups.number])
        memory = _Memory(
            position=memory.position.at[time].set(position),
            features=memory.features.at[time].set(features),
            newest=memory.newest.at[slot].max(time * batch + jnp.arange(batch)),
        )
        return features, memory

    def step(carry: _Carry, inputs: tuple[jax.Array, jax.Array]) -> tuple[_Carry, Any]:
        time, step_key = inputs
        features, memory = encode(carry.state, carry.memory, time)
        core_inputs = agent.core_inputs(params, features, carry.action_tm1, carry.reward_tm1)
        embedding = agent.advance(params, carry.embedding, core_inputs)
        outputs = agent.act(params, embedding)
        action = choose(step_key, outputs)
        state, timestep = jax.vmap(env.step)(carry.state, action)
        alive = ~(carry.state.terminated | carry.state.truncated)
        record = {
            "cells": cells_of(carry.state),
            "action": action,
            "reward": timestep.reward,
            "mask": alive.astype(jnp.float32),
            "log_prob": action_log_prob(outputs, action),
            "value": outputs.value,
            "embedding": embedding,
        }
        return _Carry(state, embedding, action, timestep.reward, memory), record

    width = jax.eval_shape(agent.encode, params, jax.vmap(observe)(initial)).shape[-1]
    start = _Carry(
        state=initial,
        embedding=agent.initial_state(params, batch),
        action_tm1=jnp.zeros((batch, 2), jnp.int32),
        reward_tm1=jnp.zeros(batch),
        memory=_Memory(
            position=jnp.zeros((env.max_steps + 1, batch), jnp.int32),
            features=jnp.zeros((env.max_steps + 1, batch, width)),
            newest=jnp.full(2**SLOT_BITS, -1),
        ),
    )
    times = jnp.arange(env.max_steps)
    end, record = jax.lax.scan(step, start, (times, jax.random.split(key, env.max_steps)))
    _, memory = encode(end.state, end.memory, env.max_steps)
    record["cells"] = jnp.concatenate([record["cells"], cells_of(end.state)[None]])
    return Trajectory(layout=initial, features=memory.features, **record)


def action_log_prob(outputs: Outputs, action: jax.Array) -> jax.Array:
    """The log-probability f32[...] of actions i32[..., 2], grasp plus move."""
    grasp, move = action[..., 0], action[..., 1]
    return log_prob(outputs.grasp_logits, grasp) + log_prob(outputs.move_logits, move)


def cells_of(state: State) -> jax.Array:
    """u8[B, 3, 2]: the cells of agent, tool and food."""
    return jnp.stack([state.agent, state.tool, state.food], axis=1).astype(jnp.uint8)
