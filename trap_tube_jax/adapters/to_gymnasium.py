"""The task sets as Gymnasium environments, one at a time or as one compiled batch.

Importing `trap_tube_jax` registers them where Gymnasium >= 1.1 is installed:

    gymnasium.make("trap_tube_jax/PerceptualTrapTube-v0")
    gymnasium.make_vec("trap_tube_jax/PerceptualTrapTube-v0", num_envs=1024)

Both take the keyword arguments of the classes below. The step limit is `max_steps`.
"""

import functools
import reprlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment
from trap_tube_jax.checks import check_integer, integer_array
from trap_tube_jax.environment import Environment, pairs_of
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import render_ascii
from trap_tube_jax.registry import make, registered_ids
from trap_tube_jax.rendering import render
from trap_tube_jax.state import take
from trap_tube_jax.vector import VectorEnvironment, VectorState
from trap_tube_jax.wrappers import AutoReset, AutoResetState

with needs_extra("gymnasium"):
    import gymnasium  # pyright: ignore[reportMissingImports]
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
    from gymnasium.vector import AutoresetMode  # pyright: ignore[reportMissingImports]
    from gymnasium.vector.utils import batch_space  # pyright: ignore[reportMissingImports]

NAMESPACE = "trap_tube_jax"
RENDER_MODES = ("rgb_array", "ansi")
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 8}
AUTORESET_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


class _Programs(NamedTuple):
    reset: Callable[..., Any]
    step: Callable[..., Any]


@functools.lru_cache(maxsize=32)
def _compile(env: AutoReset | VectorEnvironment) -> _Programs:
    """Compiles programs that equal environments share."""
    if isinstance(env, AutoReset):
        return _Programs(jax.jit(env.reset), jax.jit(env.env.step))
    return _Programs(jax.jit(env.reset), jax.jit(env.step, donate_argnums=0))


class _Compiled:
    """Mixin that runs the programs of `_pure`, and leaves them out of deep copies and pickles."""

    _pure: AutoReset | VectorEnvironment

    @functools.cached_property
    def _programs(self) -> _Programs:
        return _compile(self._pure)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_programs"}


class TrapTubeEnv(_Compiled, gymnasium.Env):
    """One environment.

    The environment truncates an episode after `max_steps` steps. After `reset(seed=s)` the task
    and all following tasks are a function of `s`.
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
        """Checks the arguments; the first reset and step compile.

        Args:
          task_set: registered id, short name or label, or an `Environment`, to which
            `num_features` and `max_steps` do not apply.
          flat_actions: takes 4 * grasp + move, `Discrete(16)`, instead of (grasp, move),
            `MultiDiscrete([4, 4])`.
          num_features: N, the feature channels of the observation; see `make`.
          max_steps: step limit instead of the set's.
          render_mode: "rgb_array", "ansi" or None.
          cell_size: pixels per cell and side of a picture.

        Raises:
          ValueError: an argument is invalid; the message says what is allowed.
        """
        if not isinstance(task_set, Environment):
            task_set = make(task_set, num_features=num_features, max_steps=max_steps)
        elif (num_features, max_steps) != (None, None):
            raise ValueError(
                f"num_features={num_features} and max_steps={max_steps} do not apply to an "
                "Environment; give them to it"
            )
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(
                f"render_mode must be None or one of {', '.join(RENDER_MODES)}, got {render_mode!r}"
            )
        self.env = task_set
        self._pure = AutoReset(task_set)
        self.render_mode = render_mode
        self.cell_size = check_integer("cell_size", cell_size)
        spec = self.env.observation_spec
        self.observation_space = spaces.Box(spec.minimum, spec.maximum, spec.shape, np.uint8)
        pair = spaces.MultiDiscrete([NUM_DIRECTIONS, NUM_DIRECTIONS])
        self.action_space = spaces.Discrete(NUM_ACTIONS) if flat_actions else pair
        self._state: AutoResetState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws the next task; `seed`, modulo 2**32, restarts the sequence of tasks.

        Raises:
          ValueError: `seed` is not an integer >= 0.
        """
        seed = None if seed is None else check_integer("seed", seed, minimum=0)
        super().reset(seed=seed)
        state = self._state
        if seed is None and state is not None:
            key = state.key
        else:
            key = _keys([int(self.np_random.integers(2**32)) if seed is None else seed])[0]
        self._state, timestep = self._programs.reset(key)
        return np.array(timestep.observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Takes one action.

        Raises:
          ValueError: the action is not in the action space.
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        state = _started(self._state)
        inner, timestep = self._programs.step(
            state.inner, _grasp_and_move(action, self.action_space)
        )
        self._state = state.replace(inner=inner)
        return (
            np.array(timestep.observation),
            float(timestep.reward),
            bool(timestep.terminated),
            bool(timestep.truncated),
            {},
        )

    def render(self) -> np.ndarray | str | None:
        """Returns the board as u8[12 s, 12 s, 3], as text or None, depending on `render_mode`.

        Raises:
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        if self.render_mode is None:
            return None
        state = _started(self._state).inner
        is_text = self.render_mode == "ansi"
        return render_ascii(state) if is_text else np.array(render(state, self.cell_size))


class TrapTubeVectorEnv(_Compiled, gymnasium.vector.VectorEnv):
    """Many environments, stepped by one compiled program.

    Environment i after `reset(seed=s)` is `TrapTubeEnv` after `reset(seed=s + i)`: the batch
    equals `gymnasium.vector.SyncVectorEnv`, autoreset included.
    """

    metadata = METADATA | {"autoreset_mode": AUTORESET_MODES[0]}

    def __init__(
        self,
        task_set: str | Environment = "TrapTube-v0",
        num_envs: int = 1,
        *,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **options: Any,
    ):
        """Checks the arguments; the first reset and step compile.

        Args:
          task_set: registered id, short name or label, or an `Environment`, not a subclass.
          num_envs: number of environments, at least 1.
          autoreset_mode: `AutoresetMode.NEXT_STEP` spends the step after the last on the
            reset; `SAME_STEP` resets within the last step and returns the last observation
            as `infos["final_obs"]`. Their names "NextStep" and "SameStep" work too.
          max_episode_steps: further step limit, as `gymnasium.make` takes it: the smaller one of
            it and the set's holds.
          **options: keyword arguments of `TrapTubeEnv`.

        Raises:
          ValueError: an argument is invalid; the message says what is allowed.
        """
        modes = {name: mode for mode in AUTORESET_MODES for name in (mode, mode.value)}
        if autoreset_mode not in modes:
            names = ", ".join(mode.value for mode in AUTORESET_MODES)
            raise ValueError(f"autoreset_mode must be one of {names}, got {autoreset_mode!r}")
        self.autoreset_mode = modes[autoreset_mode]
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self.num_envs = check_integer("num_envs", num_envs)
        one = TrapTubeEnv(task_set, **options)
        self.env = one.env
        if max_episode_steps is not None:
            limit = check_integer("max_episode_steps", max_episode_steps)
            self.env = one.env.with_max_steps(min(limit, one.env.max_steps))
        self.render_mode = one.render_mode
        self.cell_size = one.cell_size
        self.single_observation_space = one.observation_space
        self.single_action_space = one.action_space
        self.observation_space = batch_space(one.observation_space, num_envs)
        self.action_space = batch_space(one.action_space, num_envs)
        is_same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        self._pure = (VectorEnvironment if is_same_step else NextStepVectorEnvironment)(self.env)
        self._state: VectorState | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draws the next task of every environment.

        Args:
          seed: restarts the sequences of tasks, modulo 2**32. Environment i takes `seed + i`, or
            the i-th of several.
          options: none are known.

        Raises:
          ValueError: the number of seeds is not `num_envs`, one is not an integer >= 0, or there
            are options, such as a `reset_mask`.
        """
        if options:
            raise ValueError(f"reset takes no options and resets all environments, got {options}")
        self._state, timestep = self._programs.reset(self._next_keys(seed))
        return np.array(timestep.observation), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one action in every environment.

        Raises:
          ValueError: the actions are not in the action space.
          gymnasium.error.ResetNeeded: `reset` has not been called.
        """
        state = _started(self._state)
        actions = _grasp_and_move(actions, self.single_action_space, self.num_envs)
        self._state, timestep = self._programs.step(state, actions)
        terminations = np.array(timestep.terminated)
        truncations = np.array(timestep.truncated)
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
        """Returns one picture or text per environment; see `TrapTubeEnv.render`."""
        if self.render_mode is None:
            return None
        states = _started(self._state).episodes.inner
        if self.render_mode == "ansi":
            return tuple(render_ascii(take(states, index)) for index in range(self.num_envs))
        return tuple(np.array(jax.vmap(lambda state: render(state, self.cell_size))(states)))

    def _next_keys(self, seed: Any) -> jax.Array:
        """Returns one key per environment: from its seed, or the next one of its sequence."""
        if seed is None:
            if self._state is not None:
                return self._state.episodes.key
            return _keys(self.np_random.integers(2**32, size=self.num_envs).tolist())
        if np.ndim(seed):
            seeds = [check_integer("seed", one, minimum=0) for one in seed]
        else:
            first = check_integer("seed", seed, minimum=0)
            seeds = [first + index for index in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be one or {self.num_envs} integers, got {len(seeds)}")
        super().reset(seed=seeds[0])
        return _keys(seeds)


def register() -> None:
    """Registers every task set that `trap_tube_jax.make` knows and Gymnasium does not.

    Names are resolved when an environment is made, so a replaced task set needs no second call.
    Gymnasium refuses an unversioned id beside a versioned one of the same name.
    """
    for name in registered_ids():
        id = f"{NAMESPACE}/{name}"
        if id not in gymnasium.registry:
            gymnasium.register(
                id=id,
                entry_point=f"{__name__}:TrapTubeEnv",
                vector_entry_point=f"{__name__}:TrapTubeVectorEnv",
                kwargs={"task_set": name},
            )


def _keys(seeds: Sequence[Any]) -> jax.Array:
    """Returns one Threefry key per seed, modulo 2**32, such as `AutoReset` keeps."""
    numbers = np.array([seed % 2**32 for seed in seeds], np.uint32)
    return jax.vmap(functools.partial(jax.random.key, impl="threefry2x32"))(numbers)


def _started(state: Any) -> Any:
    if state is None:
        raise gymnasium.error.ResetNeeded("call reset before step and render")
    return state


def _grasp_and_move(actions: Any, space: Any, *batch: int) -> np.ndarray:
    """Returns i32[..., 2] of actions in the action space; raises ValueError for others."""
    array = np.asarray(integer_array("actions", actions))
    is_flat = isinstance(space, spaces.Discrete)
    shape = (*batch, *space.shape)
    count = NUM_ACTIONS if is_flat else NUM_DIRECTIONS
    if array.shape != shape:
        raise ValueError(
            f"actions must be integers of shape {shape}, got {array.dtype} of shape {array.shape}"
        )
    if array.min() < 0 or array.max() >= count:
        raise ValueError(f"actions must be from 0 to {count - 1}, got {reprlib.repr(actions)}")
    return pairs_of(array) if is_flat else array.astype(np.int32)


def _final_infos(observations: np.ndarray, ended: np.ndarray) -> dict[str, Any]:
    """Returns the infos of Gymnasium's vector environments for episodes that ended."""
    if not ended.any():
        return {}
    final = np.full(len(ended), None, object)
    for index in np.flatnonzero(ended):
        final[index] = np.array(observations[index])
    return {"final_obs": final, "_final_obs": ended, "final_info": {}, "_final_info": ended}


register()
