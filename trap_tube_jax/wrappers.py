"""Wrappers around an environment, pure as it is, with the same `reset` and `step`.

They are unbatched; `EpisodeStatistics` also goes around a `VectorEnvironment`.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from trap_tube_jax.checks import check_own_state
from trap_tube_jax.environment import check_key
from trap_tube_jax.prng import split
from trap_tube_jax.state import TimeStep


class EnvironmentLike(Protocol):
    """What a wrapper takes, and what it is: an environment with a state of any type.

    One that starts over by itself has an attribute `starts_over` that is true.
    """

    def reset(self, key: jax.Array, /) -> tuple[Any, TimeStep]:
        """Starts an episode."""
        ...

    def step(self, state: Any, action: jax.Array, /) -> tuple[Any, TimeStep]:
        """Takes one action."""
        ...


class AutoResetState(struct.PyTreeNode):
    """The state of an environment that starts over by itself.

    Attributes:
      inner: the wrapped environment's state.
      key: PRNG key, the source of the next episodes.
    """

    inner: Any
    key: jax.Array


class AutoResetTimeStep(TimeStep):
    """A timestep whose observation already belongs to the next episode if this one ended.

    Attributes:
      final_observation: u8[12, 12, N], the observation after the action and before any
        reset: the episode's last where `done`, `observation` elsewhere. Under jit it
        costs nothing unless it is used.
    """

    final_observation: jax.Array


class AutoReset:
    """Starts the next episode within the step that ends one.

    Reward, flags and discount are those of the step that was taken; the observation is
    the one to act on next. Every episode's task comes from a fresh key.
    """

    starts_over = True

    def __init__(self, env: EnvironmentLike):
        """Wraps an environment that does not start over by itself.

        Raises:
          ValueError: it does, or it is an `EpisodeStatistics`.
        """
        if _starts_over(env):
            raise ValueError(
                f"{type(env).__name__} starts over by itself already; allowed: an environment "
                "that does not, such as a trap_tube_jax.Environment"
            )
        if isinstance(env, EpisodeStatistics):
            raise ValueError(
                "every next episode would start with all counts at zero; allowed: "
                "EpisodeStatistics(AutoReset(env))"
            )
        self.env = env

    def reset(self, key: jax.Array) -> tuple[AutoResetState, AutoResetTimeStep]:
        """Starts the first episode. See `Environment.reset`."""
        reset_key, next_key = split(check_key(key))
        inner, timestep = self.env.reset(reset_key)
        first = auto_reset_timestep(timestep, timestep.observation, timestep.observation)
        return AutoResetState(inner, next_key), first

    def step(
        self, state: AutoResetState, action: jax.Array
    ) -> tuple[AutoResetState, AutoResetTimeStep]:
        """Takes one action and, if that ended the episode, starts the next.

        Raises:
          ValueError: `state` is not an `AutoResetState`.
        """
        check_own_state(state, AutoResetState)
        inner, timestep = self.env.step(state.inner, action)
        stepped = (AutoResetState(inner, state.key), timestep.observation)
        fresh, first = self.reset(state.key)
        next_state, observation = jax.tree.map(
            lambda new, old: jnp.where(timestep.done, new, old),
            (fresh, first.observation),
            stepped,
        )
        return next_state, auto_reset_timestep(timestep, observation, timestep.observation)


class EpisodeStatisticsState(struct.PyTreeNode):
    """The state of an environment that keeps count of its episodes.

    Around a `VectorEnvironment` of B environments the counts have the shape [B].

    Attributes:
      inner: the wrapped environment's state.
      running_return: f32[], rewards of the current episode so far.
      running_length: i32[], steps of the current episode so far.
      last_return: f32[], the undiscounted return of the last finished episode.
      last_length: i32[], the number of steps of the last finished episode.
      episodes: i32[], finished episodes since the reset.
      over: bool[], the wrapped environment has ended and does not start over.
    """

    inner: Any
    running_return: jax.Array
    running_length: jax.Array
    last_return: jax.Array
    last_length: jax.Array
    episodes: jax.Array
    over: jax.Array


class EpisodeStatistics:
    """Counts return and length of every episode of any environment, also a `VectorEnvironment`.

    Around a bare environment, steps after the end of the episode are not counted. To start
    over, wrap an `AutoReset` in it, not the other way round.
    """

    def __init__(self, env: EnvironmentLike):
        self.env = env
        self.starts_over = _starts_over(env)

    def reset(self, key: jax.Array) -> tuple[EpisodeStatisticsState, TimeStep]:
        """Starts the first episode with all counts at zero."""
        inner, timestep = self.env.reset(key)
        shape = timestep.reward.shape
        return EpisodeStatisticsState(
            inner=inner,
            running_return=jnp.zeros(shape, jnp.float32),
            running_length=jnp.zeros(shape, jnp.int32),
            last_return=jnp.zeros(shape, jnp.float32),
            last_length=jnp.zeros(shape, jnp.int32),
            episodes=jnp.zeros(shape, jnp.int32),
            over=jnp.zeros(shape, bool),
        ), timestep

    def step(
        self, state: EpisodeStatisticsState, action: jax.Array
    ) -> tuple[EpisodeStatisticsState, TimeStep]:
        """Takes one action and updates the counts.

        Raises:
          ValueError: `state` is not an `EpisodeStatisticsState`.
        """
        check_own_state(state, EpisodeStatisticsState)
        inner, timestep = self.env.step(state.inner, action)
        running_return = state.running_return + timestep.reward
        running_length = state.running_length + 1
        # A bare environment stays done: its only episode must not finish at every step.
        finished = timestep.done & ~state.over
        return EpisodeStatisticsState(
            inner=inner,
            running_return=jnp.where(timestep.done, 0.0, running_return),
            running_length=jnp.where(timestep.done, 0, running_length),
            last_return=jnp.where(finished, running_return, state.last_return),
            last_length=jnp.where(finished, running_length, state.last_length),
            episodes=state.episodes + finished,
            over=timestep.done & (not self.starts_over),
        ), timestep


def _starts_over(env: Any) -> bool:
    return bool(getattr(env, "starts_over", False))


def auto_reset_timestep(
    timestep: TimeStep, observation: jax.Array, final_observation: jax.Array
) -> AutoResetTimeStep:
    """The timestep of a step with these observations, of any shape with as many elements."""
    shape = timestep.observation.shape
    return AutoResetTimeStep(
        observation=observation.reshape(shape),
        reward=timestep.reward,
        terminated=timestep.terminated,
        truncated=timestep.truncated,
        discount=timestep.discount,
        final_observation=final_observation.reshape(shape),
    )
