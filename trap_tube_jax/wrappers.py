"""Wrappers around an environment: pure, with the same `reset` and `step`.

Wrappers are unbatched; `EpisodeStatistics` also wraps a `VectorEnvironment`. The wrapped `env`
holds the specs.
"""

import dataclasses
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import check_own_state
from trap_tube_jax.prng import threefry_key
from trap_tube_jax.state import TimeStep


class EnvironmentLike(Protocol):
    """An environment with a state of any type: wrapped by wrappers, and implemented by them.

    An environment that resets itself has an attribute `auto_resets`: "SameStep" if it does so in
    the step that ends an episode, "NextStep" if in the next step, which ignores its action.
    """

    def reset(self, key: jax.Array, /) -> tuple[Any, TimeStep]:
        """Starts an episode."""
        ...

    def step(self, state: Any, action: jax.Array, /) -> tuple[Any, TimeStep]:
        """Takes one action."""
        ...


class AutoResetState(ByValue, struct.PyTreeNode, eq=False):
    """The state of an environment that resets itself.

    Attributes:
      inner: state of the wrapped environment.
      key: typed PRNG key that draws the next episodes; a Threefry key if `reset` was given one of
        `rbg`.
    """

    inner: Any
    key: jax.Array


class AutoResetTimeStep(TimeStep, eq=False):
    """A timestep that shows the first observation of the next episode if this step ended one.

    Attributes:
      final_observation: u8[12, 12, N], the observation after the action and before any
        reset: the episode's last where `done`, else `observation`. Under jit it costs
        nothing unless it is used.
    """

    final_observation: jax.Array


@dataclasses.dataclass(frozen=True)
class AutoReset:
    """Starts the next episode within the step that ends one.

    Reward, flags and discount belong to the action taken; `observation` is the one to act on next.
    `final_observation`, u8[12, 12, N], is the one before any reset: an episode's last observation
    is not lost, and its value can be bootstrapped. Every episode draws its task with a fresh key.

    Attributes:
      env: an environment that does not reset itself.

    Raises:
      ValueError: `env` resets itself, is an `EpisodeStatistics`, or is not an environment.

    Example:
      >>> env = tt.AutoReset(tt.make("base", max_steps=1))
      >>> state, first = env.reset(jax.random.key(0))
      >>> state, timestep = env.step(state, jnp.array([0, 0]))
      >>> bool(jnp.all(timestep.observation == first.observation)), bool(timestep.truncated)
      (True, True)
      >>> bool(jnp.all(timestep.final_observation == first.observation))
      False
    """

    env: EnvironmentLike
    auto_resets: ClassVar = "SameStep"

    def __post_init__(self):
        _check_environment(self.env)
        self._check_reset(bool(_auto_resets(self.env)))
        if isinstance(self.env, EpisodeStatistics):
            raise ValueError(
                "AutoReset cannot wrap EpisodeStatistics, whose counts would start anew with every "
                "episode; allowed: EpisodeStatistics(AutoReset(env))"
            )

    def reset(self, key: jax.Array) -> tuple[AutoResetState, AutoResetTimeStep]:
        """Starts the first episode. See `Environment.reset`."""
        reset_key, next_key = jax.random.split(threefry_key(key))
        inner, timestep = self.env.reset(reset_key)
        self._check_reset(isinstance(timestep, AutoResetTimeStep))  # within a user's wrapper
        final = jnp.copy(timestep.observation)  # in other memory, so both may be donated
        first = auto_reset_timestep(timestep, timestep.observation, final)
        return AutoResetState(inner, next_key), first

    def step(
        self, state: AutoResetState, action: jax.Array
    ) -> tuple[AutoResetState, AutoResetTimeStep]:
        """Takes one action and starts the next episode if this one ended.

        Raises:
          ValueError: `state` is not an `AutoResetState`.
        """
        check_own_state(state, AutoResetState)
        inner, timestep = self.env.step(state.inner, action)
        stepped = (AutoResetState(inner, state.key), timestep.observation)
        # Clones, since `done` selects whether the reset uses the key up or the state keeps it.
        fresh, first = self.reset(jax.random.clone(state.key))
        next_state, observation = jax.tree.map(
            lambda new, old: jnp.where(timestep.done, new, old),
            (fresh, first.observation),
            stepped,
        )
        next_state = next_state.replace(key=jax.random.clone(next_state.key))
        return next_state, auto_reset_timestep(timestep, observation, timestep.observation)

    def _check_reset(self, resets_itself: bool) -> None:
        if resets_itself:
            raise ValueError(
                f"{type(self.env).__name__} resets itself already; allowed: an environment that "
                "does not, such as a trap_tube_jax.Environment"
            )


class EpisodeStatisticsState(ByValue, struct.PyTreeNode, eq=False):
    """The state of an environment that counts its episodes.

    Around a `VectorEnvironment` of B environments all counts have shape [B].

    Attributes:
      inner: state of the wrapped environment.
      running_return: f32[], rewards of the current episode so far.
      running_length: i32[], steps of the current episode so far.
      last_return: f32[], the undiscounted return of the last finished episode.
      last_length: i32[], the number of steps of the last finished episode.
      episodes: i32[], finished episodes since the reset.
      over: bool[], the last step ended an episode without starting another, so the next step is
        not counted.
    """

    inner: Any
    running_return: jax.Array
    running_length: jax.Array
    last_return: jax.Array
    last_length: jax.Array
    episodes: jax.Array
    over: jax.Array


@dataclasses.dataclass(frozen=True)
class EpisodeStatistics:
    """Records the return and length of every episode. Also wraps a `VectorEnvironment`.

    Steps after the end of a bare environment's episode do not count, nor do steps that only reset.
    For several episodes use `EpisodeStatistics(AutoReset(env))`, not the reverse.

    Attributes:
      env: an environment, wrapped or not.

    Raises:
      ValueError: `env` is no environment.

    Example:
      >>> env = tt.EpisodeStatistics(tt.AutoReset(tt.make("base", max_steps=1)))
      >>> state, timestep = env.reset(jax.random.key(0))
      >>> state, timestep = env.step(state, jnp.array([0, 0]))
      >>> int(state.episodes), int(state.last_length), float(state.last_return)
      (1, 1, 0.0)
    """

    env: EnvironmentLike

    def __post_init__(self):
        _check_environment(self.env)

    @property
    def auto_resets(self) -> str | None:
        """The step in which the wrapped environment resets: "SameStep", "NextStep" or None."""
        return _auto_resets(self.env)

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
        is_counted = ~state.over
        running_return = state.running_return + jnp.where(is_counted, timestep.reward, 0.0)
        running_length = state.running_length + is_counted.astype(jnp.int32)
        finished = timestep.done & is_counted
        # By the timestep, since a user's wrapper may hide the attribute.
        has_reset = isinstance(timestep, AutoResetTimeStep) and self.auto_resets != "NextStep"
        return EpisodeStatisticsState(
            inner=inner,
            running_return=jnp.where(timestep.done, 0.0, running_return),
            running_length=jnp.where(timestep.done, 0, running_length),
            last_return=jnp.where(finished, running_return, state.last_return),
            last_length=jnp.where(finished, running_length, state.last_length),
            episodes=state.episodes + finished.astype(jnp.int32),
            over=jnp.zeros_like(timestep.done) if has_reset else timestep.done,
        ), timestep


def _check_environment(env: Any) -> None:
    methods = (getattr(env, "reset", None), getattr(env, "step", None))
    if isinstance(env, type) or not all(map(callable, methods)):
        raise ValueError(
            f"env must be an environment with reset(key) and step(state, action), got {env!r}"
        )


def _auto_resets(env: Any) -> str | None:
    return getattr(env, "auto_resets", None)


def auto_reset_timestep(
    timestep: TimeStep, observation: jax.Array, final_observation: jax.Array
) -> AutoResetTimeStep:
    """Returns `timestep` with other observations, which may be flat."""
    shape = timestep.observation.shape
    return AutoResetTimeStep(
        observation=observation.reshape(shape),
        reward=timestep.reward,
        terminated=timestep.terminated,
        truncated=timestep.truncated,
        discount=timestep.discount,
        final_observation=final_observation.reshape(shape),
    )
