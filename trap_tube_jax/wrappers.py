"""The wrapper that starts the next episode: pure and unbatched, with the same `reset` and `step`.

The wrapped `env` holds the specs.
"""

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import check_own_state
from trap_tube_jax.prng import threefry_key
from trap_tube_jax.state import TimeStep


class EnvironmentLike(Protocol):
    """An environment with a state of any type, which may be a wrapper."""

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
      ValueError: `env` resets itself, or is not an environment.

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

    def __post_init__(self):
        methods = (getattr(self.env, "reset", None), getattr(self.env, "step", None))
        if isinstance(self.env, type) or not all(map(callable, methods)):
            raise ValueError(
                "env must be an environment with reset(key) and step(state, action), got "
                f"{self.env!r}"
            )
        self._check_reset(isinstance(self.env, AutoReset))

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
