"""Episodes, as one scan over time.

Source: paper, section "Experimental Setup".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.encodings import Cache
from agents.acting.episodes import Episodes, cells_of
from agents.acting.frames import Frame
from agents.acting.repeats import Repeats, board_ids
from agents.networks.agent import Agent, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State


class Trajectory(NamedTuple):
    """Episodes and the network's outputs, under the parameters that acted.

    Attributes:
      frame: B frames in which the episodes were played.
      episodes: B episodes of T steps, in these frames.
      features: f32[T + 1, B, F], the encoded observations.
      embedding: f32[T, B, hidden], the GRU's outputs.
      log_prob: f32[T, B], of the actions.
      value: f32[T + 1, B, V], of every observation, the last one included, by value head.
    """

    frame: Frame
    episodes: Episodes
    features: jax.Array
    embedding: jax.Array
    log_prob: jax.Array
    value: jax.Array


def rollout(
    agent: Agent, params: Params, env: Environment, initial: State, key: jax.Array | None
) -> Trajectory:
    """Plays one episode from each of B initial states.

    Args:
      agent: the network; with `align_to_food` it acts in frames that face the food.
      params: its parameters.
      env: the dynamics; `max_steps` is T.
      initial: B states at time 0.
      key: PRNG key of the actions; None takes the most probable ones after
        `repeat_penalty`.
    """
    batch, penalty = len(initial.time), agent.config.repeat_penalty
    frame = Frame.of(jnp.zeros(batch, jnp.int32))
    if agent.config.align_to_food:
        frame = jax.vmap(Frame.facing_food)(jax.vmap(observe)(initial))
        initial = jax.vmap(Frame.state)(frame, initial)

    def step(carry: Any, inputs: Any) -> Any:
        time, data = inputs
        state, embedding, action_tm1, reward_tm1, repeats, cache = carry
        features, cache = cache.encode(agent, params, state, time)
        embedding = agent.step(params, embedding, features, action_tm1, reward_tm1)
        actions, value = agent.policy_and_value(params, embedding)
        if repeats is None:
            action = actions.mode()
        else:
            seen = board_ids(jax.vmap(observe)(state))
            action = actions.mode(penalty * repeats.counts(seen))
            repeats = repeats.add(seen, action)
        if key is not None:
            action = actions.sample(jax.random.wrap_key_data(data, impl=jax.random.key_impl(key)))
        after, timestep = jax.vmap(env.step)(state, action)
        taken = {
            "action": action,
            "reward": timestep.reward,
            "discount": timestep.discount,
            "mask": (~(state.terminated | state.truncated)).astype(jnp.float32),
        }
        outputs = (cells_of(state), value, taken, embedding, actions.log_prob(action))
        return (after, embedding, action, timestep.reward, repeats, cache), outputs

    first = (
        initial,
        agent.initial_state(params, batch),
        jnp.zeros((batch, 2), jnp.int32),
        jnp.zeros(batch, jnp.float32),
        Repeats.empty(batch) if penalty and key is None else None,
        Cache.empty(agent, params, initial, env.max_steps),
    )
    # One more step than the episode has, for the last observation; states do not change any more.
    times = jnp.arange(env.max_steps + 1, dtype=jnp.int32)
    # As data: under `jax.vmap` over seeds, `jax_debug_key_reuse` takes scanned keys for used.
    keys = None if key is None else jax.random.key_data(jax.random.split(key, len(times)))
    (*_, cache), (cells, value, *outputs) = jax.lax.scan(step, first, (times, keys))
    taken, embedding, log_prob = jax.tree.map(lambda x: x[:-1], outputs)
    episodes = Episodes(initial, cells, **taken, observation_id=cache.observation_id())
    return Trajectory(frame, episodes, cache.features, embedding, log_prob, value)
