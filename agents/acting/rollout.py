"""Episodes, as one scan over time.

Source: paper, section "Experimental Setup".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.encodings import Cache
from agents.acting.episodes import Episodes, cells_of
from agents.acting.frames import Frame
from agents.acting.repeats import Repeats
from agents.networks.agent import Agent, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State


class Trajectory(NamedTuple):
    """Episodes and the network's outputs, under the parameters that acted.

    Attributes:
      frame: B frames in which the episodes were played.
      episodes: B episodes of T steps, in these frames.
      log_prob: f32[T, B], of the actions.
      value: f32[T + 1, B, V], one value per head for every observation, including the last.
    """

    frame: Frame
    episodes: Episodes
    log_prob: jax.Array
    value: jax.Array


def rollout(
    agent: Agent, params: Params, env: Environment, initial: State, key: jax.Array | None
) -> Trajectory:
    """Plays one episode of T = `env.max_steps` steps from each of B states at time 0.

    Draws the actions with `key`; None takes the most probable ones after `repeat_penalty`. With
    `align_to_food` the agent acts in frames that face the food.
    """
    batch, penalty = len(initial.time), agent.config.repeat_penalty
    frame = Frame.of(jnp.zeros(batch, jnp.int32))
    if agent.config.align_to_food:
        frame = jax.vmap(Frame.facing_food)(jax.vmap(observe)(initial))
        initial = jax.vmap(Frame.state)(frame, initial)

    def step(carry: Any, time: jax.Array) -> Any:
        state, embedding, action_tm1, reward_tm1, repeats, cache = carry
        features, cache = cache.encode(agent, params, state, time)
        embedding = agent.step(params, embedding, features, action_tm1, reward_tm1)
        actions, value = agent.policy_and_value(params, embedding)
        if key is not None:
            action = actions.sample(jax.random.fold_in(key, time))
        elif repeats is None:
            action = actions.mode()
        else:
            action, repeats = repeats.choose(actions, penalty, jax.vmap(observe)(state))
        after, timestep = jax.vmap(env.step)(state, action)
        taken = {
            "action": action,
            "reward": timestep.reward,
            "discount": timestep.discount,
            "mask": (~state.done).astype(jnp.float32),
        }
        outputs = (cells_of(state), value, taken, actions.log_prob(action))
        return (after, embedding, action, timestep.reward, repeats, cache), outputs

    first = (
        initial,
        agent.initial_state(params, batch),
        jnp.zeros((batch, 2), jnp.int32),
        jnp.zeros(batch, jnp.float32),
        Repeats.empty(batch) if penalty and key is None else None,
        Cache.empty(agent, params, initial, env.max_steps),
    )
    # One extra step records the last observation; states no longer change in this step.
    times = jnp.arange(env.max_steps + 1, dtype=jnp.int32)
    (*_, cache), (cells, value, *outputs) = jax.lax.scan(step, first, times)
    taken, log_prob = jax.tree.map(lambda x: x[:-1], outputs)
    episodes = Episodes(initial, cells, **taken, observation_id=cache.observation_id())
    return Trajectory(frame, episodes, log_prob, value)
