"""The task sets as Gymnasium environments, one at a time or as one compiled batch.

Importing `trap_tube_jax` registers them, where Gymnasium >= 1.1 is installed:

    gymnasium.make("trap_tube_jax/PerceptualTrapTube-v0")
    gymnasium.make_vec("trap_tube_jax/PerceptualTrapTube-v0", num_envs=1024)

Keyword arguments of both are those of the classes below. The step limit is `max_steps`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment
from trap_tube_jax.checks import check_integer
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import render_ascii
from trap_tube_jax.registry import make, registered_ids
from trap_tube_jax.rendering import render
from trap_tube_jax.vector import VectorEnvironment, VectorState
from trap_tube_jax.wrappers import AutoReset, AutoResetState

try:
    import gymnasium  # pyright: ignore[reportMissingImports]
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from gymnasium.vector import AutoresetMode  # pyright: ignore[reportMissingImports]
    from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ImportError(
        "trap_tube_jax.adapters.to_gymnasium needs Gymnasium >= 1.1: "
        "pip install 'trap-tube-jax[interop]'"
    ) from error

NAMESPACE = "trap_tube_jax"
RENDER_MODES = ("rgb_array", "ansi")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 8}
AUTORESET_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


class TrapTubeEnv(gymnasium.Env):
    """One environment.

    An episode truncates after `max_steps` by itself. `reset(seed=s)` makes the task and
    all that follow a function of `s`.
    """

    metadata = METADATA

    def __init__(
        self,
        task_set: str | Environment = "TrapTube-v0",
        *,
        flat_actions: bool = False,
        num_features: int | None = None,
        max_steps: int | None = None,
        render_mode: str | None = None,
        cell_size: int = 32,
    ):
        """Checks its arguments; compiles at the first reset and step.

        Args:
          task_set: a registered id or short name, or an `Environment` of your own, to
            which `num_features` and `max_steps` do not apply.
          flat_actions: takes 4 * grasp + move, `Discrete(16)`, instead of (grasp, move),
            `MultiDiscrete([4, 4])`.
          num_features: N, the feature channels of the observation; see `make`.
          max_steps: a step limit in place of the set's.
          render_mode: "rgb_array", "ansi" or None.
          cell_size: pixels per cell and side of a picture.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        self.env = _environment(task_set, num_features, max_steps)
        self.flat_actions = flat_actions
        self.render_mode = _check_render_mode(render_mode)
        self.cell_size = check_integer("cell_size", cell_size)
        self.observation_space = _observation_space(self.env)
        self.action_space = _action_space(flat_actions)
        self._programs = _single_programs(self.env)
        self._state: AutoResetState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws the next task; `seed` starts the sequence of tasks anew."""
        super().reset(seed=seed)
        if seed is not None or self._state is None:
            key = _keys([self.np_random_seed])[0]
        else:
            key = self._state.key
        self._state, timestep = self._programs.reset(key)
        return np.array(timestep.observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one action.

        Raises:
          ValueError: the action is not in the action space.
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        state = self._started()
        action = _grasp_and_move(action, self.action_space.shape, self.flat_actions)
        inner, timestep = self._programs.step(state.inner, action)
        self._state = state.replace(inner=inner)
        return (
            np.array(timestep.observation),
            float(timestep.reward),
            bool(timestep.terminated),
            bool(timestep.truncated),
            {},
        )

    def render(self) -> np.ndarray | str | None:
        """The board as u8[12 s, 12 s, 3] or as text, after `render_mode`.

        Raises:
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render does nothing: the environment has no render_mode")
            return None
        state = self._started().inner
        if self.render_mode == "ansi":
            return render_ascii(state)
        return np.array(render(state, self.cell_size))

    def _started(self) -> AutoResetState:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step and render")
        return self._state


class TrapTubeVectorEnv(gymnasium.vector.VectorEnv):
    """Many environments, stepped by one compiled program.

    Environment i under `reset(seed=s)` is `TrapTubeEnv` under `reset(seed=s + i)`: the
    batch equals `gymnasium.vector.SyncVectorEnv`, autoreset included.
    """

    metadata = METADATA | {"autoreset_mode": AUTORESET_MODES[0], "autoreset_modes": AUTORESET_MODES}

    def __init__(
        self,
        task_set: str | Environment = "TrapTube-v0",
        num_envs: int = 1,
        *,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        flat_actions: bool = False,
        num_features: int | None = None,
        max_steps: int | None = None,
        render_mode: str | None = None,
        cell_size: int = 32,
    ):
        """Checks its arguments; compiles at the first reset and step.

        Args:
          task_set: see `TrapTubeEnv`, as are the arguments not listed here.
          num_envs: the number of environments, at least 1.
          autoreset_mode: `AutoresetMode.NEXT_STEP` spends the step after the last on the
            reset; `SAME_STEP` resets within the last step and hands the last observation
            out as `infos["final_obs"]`. Their names "NextStep" and "SameStep" work too.
          flat_actions: see `TrapTubeEnv`.
          num_features: see `TrapTubeEnv`.
          max_steps: see `TrapTubeEnv`.
          render_mode: see `TrapTubeEnv`.
          cell_size: see `TrapTubeEnv`.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        self.num_envs = num_envs = check_integer("num_envs", num_envs)
        self.env = _environment(task_set, num_features, max_steps)
        self.autoreset_mode = _check_autoreset_mode(autoreset_mode)
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self.flat_actions = flat_actions
        self.render_mode = _check_render_mode(render_mode)
        self.cell_size = check_integer("cell_size", cell_size)
        self.single_observation_space = _observation_space(self.env)
        self.single_action_space = _action_space(flat_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._programs = _batch_programs(self.env, self.autoreset_mode == AutoresetMode.SAME_STEP)
        self._state: VectorState | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws the next task of every environment.

        Args:
          seed: starts the sequences of tasks anew: environment i has `seed + i`, or the
            i-th of several.
          options: ignored.

        Raises:
          ValueError: there are not as many seeds as environments, or one is no integer >= 0.
        """
        if seed is not None or self._state is None:
            keys = _keys(self._seeds(seed))
        else:
            keys = self._state.episodes.key
        self._state, timestep = self._programs.reset(keys)
        return np.array(timestep.observation), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one action in every environment.

        Raises:
          ValueError: the actions are not in the action space.
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        state = self._started()
        actions = _grasp_and_move(actions, self.action_space.shape, self.flat_actions)
        self._state, timestep = self._programs.step(state, actions)
        terminations, truncations = np.array(timestep.terminated), np.array(timestep.truncated)
        infos: dict[str, Any] = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            infos = _final_infos(np.asarray(timestep.final_observation), terminations | truncations)
        return (
            np.array(timestep.observation),
            np.array(timestep.reward, np.float64),
            terminations,
            truncations,
            infos,
        )

    def render(self) -> tuple[np.ndarray | str, ...] | None:
        """One picture per environment. See `TrapTubeEnv.render`."""
        if self.render_mode is None:
            gymnasium.logger.warn("render does nothing: the environment has no render_mode")
            return None
        states = self._started().episodes.inner
        if self.render_mode == "ansi":
            return tuple(
                render_ascii(jax.tree.map(lambda x, i=index: x[i], states))
                for index in range(self.num_envs)
            )
        return tuple(np.array(jax.vmap(lambda state: render(state, self.cell_size))(states)))

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int]:
        """One seed per environment."""
        if seed is None or isinstance(seed, int) or np.ndim(seed) == 0:
            super().reset(seed=None if seed is None else check_integer("seed", seed, minimum=0))
            return [self.np_random_seed + index for index in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be one or {self.num_envs} integers, got {len(seed)}")
        seeds = [check_integer("seed", each, minimum=0) for each in seed]
        super().reset(seed=seeds[0])
        return seeds

    def _started(self) -> VectorState:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step and render")
        return self._state


def register() -> None:
    """Registers every task set that `trap_tube_jax.make` knows and Gymnasium does not."""
    for name in registered_ids():
        id = f"{NAMESPACE}/{name}"
        if id not in gymnasium.registry:
            gymnasium.register(
                id=id,
                entry_point=f"{__name__}:TrapTubeEnv",
                vector_entry_point=f"{__name__}:TrapTubeVectorEnv",
                kwargs={"task_set": name},
            )


class _Programs(NamedTuple):
    """Compiled functions, shared by all environments of the same task set."""

    reset: Callable[..., Any]
    step: Callable[..., Any]


@functools.lru_cache(maxsize=32)
def _single_programs(env: Environment) -> _Programs:
    return _Programs(jax.jit(AutoReset(env).reset), jax.jit(env.step))


@functools.lru_cache(maxsize=32)
def _batch_programs(env: Environment, same_step: bool) -> _Programs:
    batch = VectorEnvironment(env) if same_step else NextStepVectorEnvironment(env)
    return _Programs(jax.jit(batch.reset), jax.jit(batch.step, donate_argnums=0))


def _environment(
    task_set: str | Environment, num_features: int | None, max_steps: int | None
) -> Environment:
    if not isinstance(task_set, Environment):
        return _registered(task_set, num_features, max_steps)
    if (num_features, max_steps) != (None, None):
        raise ValueError(
            f"num_features={num_features} and max_steps={max_steps} do not apply to an "
            "Environment of your own; give them to it"
        )
    return task_set


@functools.lru_cache(maxsize=32)
def _registered(name: str, num_features: int | None, max_steps: int | None) -> Environment:
    return make(name, num_features=num_features, max_steps=max_steps)


def _observation_space(env: Environment) -> Any:
    spec = env.observation_spec
    return spaces.Box(spec.minimum, spec.maximum, spec.shape, spec.dtype.type)


def _action_space(flat: bool) -> Any:
    if flat:
        return spaces.Discrete(NUM_ACTIONS)
    return spaces.MultiDiscrete([NUM_DIRECTIONS, NUM_DIRECTIONS])


def _grasp_and_move(actions: Any, shape: tuple[int, ...], flat: bool) -> np.ndarray:
    """i32[..., 2] of actions in the action space. Raises ValueError for others."""
    array = np.asarray(actions)
    count = NUM_ACTIONS if flat else NUM_DIRECTIONS
    if array.shape != shape or array.dtype.kind not in "iu":
        raise ValueError(
            f"actions must be integers of shape {shape}, got {array.dtype} of shape {array.shape}"
        )
    if array.min() < 0 or array.max() >= count:
        raise ValueError(f"actions must lie in 0 to {count - 1}, got {actions!r}")
    if flat:
        array = np.stack(np.divmod(array, NUM_DIRECTIONS), axis=-1)
    return array.astype(np.int32)


def _keys(seeds: Sequence[int]) -> jax.Array:
    """One PRNG key per seed; seeds count modulo 2^32."""
    return jax.vmap(jax.random.key)(np.array([seed % 2**32 for seed in seeds], np.uint32))


def _final_infos(observations: np.ndarray, ended: np.ndarray) -> dict[str, Any]:
    """What Gymnasium's own vector environments report on the episodes that ended."""
    if not ended.any():
        return {}
    final = np.full(len(ended), None, object)
    for index in np.flatnonzero(ended):
        final[index] = np.array(observations[index])
    return {"final_obs": final, "_final_obs": ended, "final_info": {}, "_final_info": ended}


def _check_render_mode(render_mode: str | None) -> str | None:
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {render_mode!r}"
        )
    return render_mode


def _check_autoreset_mode(mode: Any) -> Any:
    for candidate in AUTORESET_MODES:
        if mode in (candidate, candidate.value):
            return candidate
    names = ", ".join(candidate.value for candidate in AUTORESET_MODES)
    raise ValueError(f"autoreset_mode must be one of {names}, got {mode!r}")


register()
