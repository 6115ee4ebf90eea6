"""Episodes, as one scan over time.

Source: paper, section "Experimental Setup".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.acting.encoding import Encoding
from agents.acting.episodes import Episodes, cells_of
from agents.acting.step import Memory, choose
from agents.acting.symmetry import Symmetry
from agents.networks.agent import Agent, Params


class Trajectory(NamedTuple):
    """Episodes and the network's outputs, under the parameters that acted.

    Attributes:
      symmetry: B symmetries, by which the boards were turned before the episodes were played.
      episodes: B episodes of T steps, on the turned boards.
      log_prob: f32[B, T], of the actions.
      value: f32[B, T + 1, V], one value per head for every observation, including the last.
    """

    symmetry: Symmetry
    episodes: Episodes
    log_prob: jax.Array
    value: jax.Array


def rollout(
    agent: Agent,
    params: Params,
    env: tt.Environment,
    initial: tt.State,
    key: jax.Array | None,
    encoding: Encoding | None = None,
) -> Trajectory:
    """Plays one episode of T = `env.max_steps` steps from each of B states at time 0.

    Args:
      agent: functions of the policy network.
      params: its parameters.
      env: dynamics and step limit; its transfers are not used.
      initial: B states. With `align_to_food` their boards are turned first.
      key: PRNG key of the draws; None takes the most probable actions after `repeat_penalty`.
      encoding: encodes observations; by default every one by itself.
    """
    encoding = encoding or Encoding(agent)
    symmetry = Symmetry.from_index(jnp.zeros(len(initial.time), jnp.int32))
    if agent.config.align_to_food:
        symmetry = jax.vmap(Symmetry.facing_food)(jax.vmap(tt.observe)(initial))
        initial = jax.vmap(Symmetry.transform_state)(symmetry, initial)

    def step(carry: tuple[tt.State, Memory, Any], time: jax.Array) -> Any:
        state, memory, encoded = carry
        features, encoded = encoding.step(params, state, time, encoded)
        step_key = None if key is None else jax.random.fold_in(key, time)
        observation = jax.vmap(tt.observe)(state)
        choice, memory = choose(agent, params, memory, features, observation, step_key)
        after, timestep = jax.vmap(env.step)(state, choice.action)
        cells = jax.vmap(cells_of)(state)
        memory = memory._replace(reward_tm1=timestep.reward)
        mask = (~state.done).astype(jnp.float32)
        return (after, memory, encoded), (cells, choice, timestep.reward, timestep.discount, mask)

    memory = Memory.empty(agent, params, len(initial.time), greedy=key is None)
    carry = (initial, memory, encoding.start(params, initial, env.max_steps))
    # One extra step records the last observation; states no longer change in this step.
    times = jnp.arange(env.max_steps + 1, dtype=jnp.int32)
    _, recorded = jax.lax.scan(step, carry, times)
    cells, choice, *outcome = jax.tree.map(lambda x: x.swapaxes(0, 1), recorded)
    reward, discount, mask = (x[:, :-1] for x in outcome)
    episodes = Episodes(initial, cells, choice.action[:, :-1], reward, discount, mask)
    return Trajectory(symmetry, episodes, choice.log_prob[:, :-1], choice.value)
