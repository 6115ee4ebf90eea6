"""A batch of environments that start over by themselves, resetting only those that ended.

`jax.vmap` of `AutoReset` draws a new task for every environment at every step and drops
nearly all of them. That suits a GPU; on a CPU drawing is the costliest part of a step.
"""

import jax
import jax.numpy as jnp

from trap_tube_jax.environment import Environment
from trap_tube_jax.wrappers import AutoReset, AutoResetState, AutoResetTimeStep

CHUNK = 32  # resets at a time; 1,024 episodes of 50 steps end at 20 a step


def reset_batch(env: Environment, keys: jax.Array) -> tuple[AutoResetState, jax.Array]:
    """Starts a batch of episodes.

    Args:
      env: the environment.
      keys: PRNG keys [B], one per environment: the source of all its tasks.

    Returns:
      The batched state, and the observations u8[B, 12, 12, N].
    """
    state, timestep = jax.vmap(AutoReset(env).reset)(keys)
    return state, timestep.observation


def step_batch(
    env: Environment, state: AutoResetState, actions: jax.Array, *, same_step: bool
) -> tuple[AutoResetState, AutoResetTimeStep]:
    """Takes one action in every environment and starts those over that have ended.

    Args:
      env: the environment.
      state: the batched state.
      actions: i32[B, 2], (grasp, move) pairs.
      same_step: True starts the next episode within the step that ends one, as
        `AutoReset` does, with the same keys and results. False takes the step after it,
        which then ignores its action and pays 0.

    Returns:
      The batched state and timestep. `final_observation` is the observation before any
      reset.
    """
    was_done = state.inner.terminated | state.inner.truncated
    inner, timestep = jax.vmap(env.step)(state.inner, actions)
    stepped = (AutoResetState(inner, state.key), timestep.observation)
    state, observation = _restart(env, *stepped, ended=timestep.done if same_step else was_done)
    return state, AutoResetTimeStep(
        observation=observation,
        reward=timestep.reward,
        terminated=timestep.terminated & ~was_done,
        truncated=timestep.truncated & ~was_done,
        discount=jnp.where(was_done, 1.0, timestep.discount),
        final_observation=timestep.observation,
    )


def _restart(
    env: Environment, state: AutoResetState, observation: jax.Array, ended: jax.Array
) -> tuple[AutoResetState, jax.Array]:
    """Resets the environments where `ended` bool[B], a chunk of them at a time."""
    size = len(ended)
    # The indices of the ended ones come first; the padding lies outside and is dropped.
    indices = jnp.nonzero(ended, size=size + CHUNK, fill_value=size)[0]

    def unfinished(carry: tuple) -> jax.Array:
        return carry[0] < jnp.sum(ended)

    def reset_chunk(carry: tuple) -> tuple:
        first, state, observation = carry
        chunk = jax.lax.dynamic_slice(indices, (first,), (CHUNK,))
        fresh = reset_batch(env, state.key[chunk])
        state, observation = jax.tree.map(
            lambda old, new: old.at[chunk].set(new, mode="drop"), (state, observation), fresh
        )
        return first + CHUNK, state, observation

    _, state, observation = jax.lax.while_loop(unfinished, reset_chunk, (0, state, observation))
    return state, observation
