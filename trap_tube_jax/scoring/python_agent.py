"""Agents in plain Python, which act on one observation at a time."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from trap_tube_jax.environment import pairs_of
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.observation import observe
from trap_tube_jax.state import State


class PythonAgent:
    """Plays tasks with an agent of one of the kinds that `score_gymnasium` describes."""

    def __init__(self, agent: Any):
        """Looks up how to call the agent.

        Raises:
          ValueError: the agent has no function to call, or one that needs other arguments, or it
            expects observations of another dtype than uint8.
        """
        found = [getattr(agent, name, None) for name in ("predict", "act")]
        act = next(filter(callable, found), None)
        if act is None:
            raise ValueError(
                f"an agent has predict(observation) or act(observation); {type(agent).__name__} "
                "has neither"
            )
        known = list(inspect.signature(act).parameters)[1:]  # without the observation
        self._act: Any = act
        self._takes_state = "state" in known
        self._options = {"deterministic": True} if "deterministic" in known else {}
        given = {"state": None, **self._options} if self._takes_state else self._options
        try:
            inspect.signature(act).bind(None, **given)
        except TypeError as error:
            raise ValueError(
                f"an agent acts by predict(observation) or act(observation): {error}; "
                "for a policy with act(observation, carry, key) use tt.score"
            ) from None
        self._reset = getattr(agent, "reset", None)
        self._normalize = _normalization(agent)

    def play(self, step: Callable[..., Any], state: State) -> tuple[bool, int]:
        """Plays one task by `Environment.step`; returns solved and the number of steps.

        Raises:
          ValueError: the agent returns an invalid action.
        """
        if callable(self._reset):
            self._reset()
        observation = np.array(observe(state))
        memory = None
        while not state.done:
            observation = self._normalize(observation)
            if self._takes_state:
                action, memory = self._act(observation, state=memory, **self._options)
            else:
                action = self._act(observation, **self._options)
            state, timestep = step(state, _grasp_and_move(action))
            observation = np.array(timestep.observation)
        return bool(state.terminated), int(state.time)


def _normalization(agent: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Returns the function that prepares u8[12, 12, N] as in the training of the agent."""
    find: Any = getattr(agent, "get_vec_normalize_env", None)  # of Stable-Baselines3
    normalizer: Any = find() if callable(find) else None
    if normalizer is not None:
        return normalizer.normalize_obs
    dtype = getattr(getattr(agent, "observation_space", None), "dtype", None)
    if dtype is not None and dtype != np.uint8:
        raise ValueError(
            f"the agent acts on {dtype}, and observations are uint8; a model that was trained "
            "behind VecNormalize needs it again: model.set_env(VecNormalize.load(...))"
        )
    return lambda observation: observation


def _grasp_and_move(action: Any) -> np.ndarray:
    """Converts (grasp, move) or 4 * grasp + move to i32[2]; raises ValueError for the rest."""
    try:
        array = np.asarray(action)
    except ValueError:  # ragged
        array = np.zeros(0)
    count = {1: NUM_ACTIONS, 2: NUM_DIRECTIONS}.get(array.size, 0)
    if not count or array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= count:
        raise ValueError(
            f"an action is (grasp, move), each in 0 to {NUM_DIRECTIONS - 1}, or 4 * grasp + move, "
            f"in 0 to {NUM_ACTIONS - 1}; got {action!r}"
        )
    pair = array if array.size == 2 else pairs_of(array)
    return pair.reshape(2).astype(np.int32)
