"""The task sets as gymnax environments, with the step of gymnax 0.x or of gymnax >= 1.0.

A step of gymnax 0.x returns five values, which PureJaxRL and rejax expect with any gymnax:
`make` and `FiveValueTrapTube`. A step of gymnax 1.0 returns six values:
`SixValueTrapTube`, which importing this module registers.

    env, params = to_gymnax.make("TrapTube-v0")
    observation, state, reward, done, info = env.step(key, state, action, params)

    env, params = gymnax.make("TrapTube-v0")    # gymnax >= 1.0
    observation, state, reward, terminated, truncated, info = env.step(...)
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from trap_tube_jax.environment import MAX_TIME, Environment, action_from_index
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.objects import MAX_STEPS, NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import observe
from trap_tube_jax.registry import make as make_environment
from trap_tube_jax.registry import registered_ids
from trap_tube_jax.state import State, TimeStep

with needs_extra("gymnax"):
    import gymnax  # pyright: ignore[reportMissingImports]
    from gymnax.environments import environment, spaces  # pyright: ignore[reportMissingImports]

HAS_SIX_VALUES = hasattr(gymnax, "register")  # gymnax >= 1.0


@struct.dataclass
class EnvParams(environment.EnvParams):
    """Parameters that may differ between calls without compiling again.

    Attributes:
      max_steps_in_episode: i32[], steps after which an unsolved episode is truncated.
    """

    max_steps_in_episode: Any = MAX_STEPS


class _TrapTube(environment.Environment):
    """The parts that both steps share."""

    def __init__(
        self,
        task_set: str | Environment = "TrapTube-v0",
        *,
        flat_actions: bool = True,
        num_features: int | None = None,
    ):
        """Checks the arguments.

        Args:
          task_set: registered id, short name or label, or an `Environment`, whose number of
            features and, as the default parameter, step limit hold.
          flat_actions: takes 4 * grasp + move, `Discrete(16)`, instead of (grasp, move),
            `Tuple((Discrete(4), Discrete(4)))` or i32[2]. Any other number means no direction.
          num_features: N, the feature channels of the observation; see `trap_tube_jax.make`.

        Raises:
          ValueError: an argument is invalid; the message says what is allowed.
        """
        super().__init__()
        if not isinstance(task_set, Environment):
            self._name = task_set
            task_set = make_environment(task_set, num_features=num_features)
        elif num_features is not None:
            raise ValueError(
                f"num_features={num_features} does not apply to an Environment; give it the base "
                "state you mean"
            )
        else:
            self._name = repr(task_set)
        self._default_max_steps = task_set.max_steps
        self._env = task_set.with_max_steps(MAX_TIME)  # the limit in the parameters replaces it
        self.flat_actions = flat_actions

    @property
    def default_params(self) -> EnvParams:
        """Returns the step limit of the task set or `Environment`: 50 for the paper's sets."""
        return EnvParams(max_steps_in_episode=self._default_max_steps)

    @property
    def name(self) -> str:
        """Returns the task set's name."""
        return self._name

    @property
    def num_actions(self) -> int:
        """Returns the number of (grasp, move) pairs, 16."""
        return NUM_ACTIONS

    def reset_env(self, key: jax.Array, params: EnvParams) -> tuple[jax.Array, State]:
        """Draws a task and returns (observation u8[12, 12, N], state)."""
        del params
        state, timestep = self._env.reset(key)
        return timestep.observation, state

    def get_obs(self, state: State, params: Any = None, key: Any = None) -> jax.Array:
        """Returns the observation u8[12, 12, N]."""
        del params, key
        return observe(state)

    def is_terminated(self, state: State, params: EnvParams) -> jax.Array:
        """Returns bool[]: the task is solved."""
        del params
        return state.terminated

    def is_truncated(self, state: State, params: EnvParams) -> jax.Array:
        """Returns bool[]: the episode has reached the step limit without success."""
        at_limit = state.time >= params.max_steps_in_episode
        return state.truncated | (~state.terminated & at_limit)

    def action_space(self, params: EnvParams | None = None) -> Any:
        """Returns `Discrete(16)`, or two `Discrete(4)`."""
        del params
        if self.flat_actions:
            return spaces.Discrete(NUM_ACTIONS)
        return spaces.Tuple((spaces.Discrete(NUM_DIRECTIONS), spaces.Discrete(NUM_DIRECTIONS)))

    def observation_space(self, params: EnvParams | None = None) -> Any:
        """Returns `Box(0, 255, (12, 12, N), uint8)`."""
        del params
        return spaces.Box(0, 255, self._env.observation_spec.shape, jnp.uint8)

    def _transition(self, state: State, action: Any, params: EnvParams) -> tuple[State, TimeStep]:
        """Takes the environment's step under the step limit in `params`."""
        state, timestep = self._env.step(state, _pair(action) if self.flat_actions else action)
        truncated = self.is_truncated(state, params)
        return state.replace(truncated=truncated), timestep.replace(truncated=truncated)


def _pair(index: Any) -> jax.Array:
    """Returns the action i32[2] of an index; raises ValueError for pairs."""
    if np.ndim(index):
        raise ValueError(
            "an action is one index 4 * grasp + move; make the environment with flat_actions=False "
            f"to pass (grasp, move), got shape {np.shape(index)}"
        )
    return action_from_index(index)


class FiveValueTrapTube(_TrapTube):
    """The environment of gymnax 0.x: (observation, state, reward, done, info).

    `done` is true where the episode terminates or is truncated; state and observation then start
    the next episode. `info` holds the scalars discount, terminated and truncated.
    """

    @functools.partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: State, action: Any, params: EnvParams | None = None
    ) -> tuple[jax.Array, State, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Takes one action and, if that ended the episode, draws the next task."""
        params = self.default_params if params is None else params
        step_key, reset_key = jax.random.split(key)
        stepped = self.step_env(step_key, state, action, params)
        observation, state, reward, done, info = stepped
        observation, state = jax.tree.map(
            lambda new, old: jnp.where(done, new, old),
            self.reset_env(reset_key, params),
            (observation, state),
        )
        return observation, state, reward, done, info

    def step_env(
        self, key: jax.Array, state: State, action: Any, params: EnvParams
    ) -> tuple[jax.Array, State, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Takes one action; a finished episode stays as it is."""
        del key
        state, timestep = self._transition(state, action, params)
        info = {
            "discount": timestep.discount,
            "terminated": timestep.terminated,
            "truncated": timestep.truncated,
        }
        return timestep.observation, state, timestep.reward, timestep.done, info

    def is_terminal(self, state: State, params: EnvParams) -> jax.Array:
        """Returns bool[]: the episode has terminated or is truncated."""
        return self.is_terminated(state, params) | self.is_truncated(state, params)

    def discount(self, state: State, params: EnvParams) -> jax.Array:
        """Returns f32[]: 0 where the task is solved, else 1."""
        return 1.0 - self.is_terminated(state, params).astype(jnp.float32)


class SixValueTrapTube(_TrapTube):
    """The environment of gymnax >= 1.0, whose base class resets it after an episode.

    A step returns (observation, state, reward, terminated, truncated, info). `info` holds
    discount, terminated, truncated, and final_observation, the observation before any reset.
    """

    def step_env(
        self, key: jax.Array, state: State, action: Any, params: EnvParams
    ) -> tuple[jax.Array, State, jax.Array, jax.Array, dict[str, jax.Array]]:
        """Takes one action and returns (observation, state, reward, terminated, info)."""
        del key
        state, timestep = self._transition(state, action, params)
        info = {"discount": timestep.discount}
        return timestep.observation, state, timestep.reward, timestep.terminated, info


def make(task_set: str | Environment = "TrapTube-v0", **options: Any) -> tuple[Any, EnvParams]:
    """Returns a five-value environment and its default parameters; see `FiveValueTrapTube`."""
    env = FiveValueTrapTube(task_set, **options)
    return env, env.default_params


def register() -> None:
    """Registers every task set that `trap_tube_jax.make` knows and gymnax does not.

    Raises:
      ImportError: the installed gymnax is older than 1.0 and has no registration.
    """
    if not HAS_SIX_VALUES:
        raise ImportError("gymnax before 1.0 has no registration; use to_gymnax.make instead")
    for name in registered_ids():
        if name not in gymnax.registered_envs:
            gymnax.register(name, functools.partial(SixValueTrapTube, name))


if HAS_SIX_VALUES:
    register()
