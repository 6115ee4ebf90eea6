"""Whether a curiosity of your own does what `Curiosity` promises, told by shapes alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import BOARD_SIZE

NEEDS_EMBEDDINGS = (
    "; embedding, next_embedding and action_embedding are None unless needs_embeddings = True"
)


def check_curiosity(curiosity: Any, config: Config, env: Environment) -> None:
    """Traces the functions of a curiosity, without any computation.

    Raises:
      ValueError: it is no `Curiosity`, one of its functions fails, or `reward` returns something
        else than the reward f32[T, B] and a memory like the one before.
    """
    if not isinstance(curiosity, Curiosity):
        raise ValueError(
            f"curiosity {config.curiosity!r} must be an agents.curiosity.Curiosity, "
            f"got {curiosity!r}"
        )
    board = _array(jnp.uint8, 1, BOARD_SIZE, BOARD_SIZE, env.num_features)
    params = _traced(curiosity, curiosity.init, jax.eval_shape(lambda: jax.random.key(0)), board)
    memory = _traced(curiosity, curiosity.memory)
    experience = shapes_of(curiosity, params, config, env)
    result = _traced(curiosity, curiosity.reward, params, memory, experience)
    wanted = (experience.episodes.reward, memory)
    if _described(result) != _described(wanted):
        raise ValueError(
            f"{type(curiosity).__name__}.reward must return (reward f32[T, B], memory), here "
            f"{_described(wanted)}, got {_described(result)}"
        )
    _traced(curiosity, curiosity.losses, params, experience)


def shapes_of(curiosity: Curiosity, params: Params, config: Config, env: Environment) -> Experience:
    """The shapes of what a curiosity sees of an iteration's episodes."""
    steps, batch = env.max_steps, config.episodes_per_iteration
    per_step = _array(jnp.float32, steps, batch)
    episodes = Episodes(
        layout=jax.tree.map(lambda x: _array(x.dtype, batch, *x.shape), env.base),
        cells=_array(jnp.uint8, steps + 1, batch, 3, 2),
        action=_array(jnp.int32, steps, batch, 2),
        reward=per_step,
        discount=per_step,
        mask=per_step,
    )
    rows = _array(jnp.uint8, 1, BOARD_SIZE, BOARD_SIZE, env.num_features)
    features = _traced(curiosity, curiosity.encode, params, rows)
    experience = Experience(
        episodes=episodes,
        observation_id=_array(jnp.int32, steps + 1, batch),
        features=_array(features.dtype, steps + 1, batch, *features.shape[1:]),
    )
    if not curiosity.needs_embeddings:
        return experience
    embedding = _array(jnp.float32, steps, batch, config.hidden)
    return experience._replace(
        embedding=embedding,
        next_embedding=embedding,
        action_embedding=_array(jnp.float32, steps, batch, 2 * config.embedding),
    )


def _traced(curiosity: Curiosity, function: Callable[..., Any], *args: Any) -> Any:
    """The shapes that one of the curiosity's functions returns."""
    try:
        return jax.eval_shape(function, *args)
    except (AttributeError, TypeError, ValueError) as error:
        lacks = "None" in str(error) and not curiosity.needs_embeddings
        hint = NEEDS_EMBEDDINGS if lacks else ""
        raise ValueError(
            f"{type(curiosity).__name__}.{function.__name__} failed: {type(error).__name__}: "
            f"{error}{hint}"
        ) from error


def _array(dtype: Any, *shape: int) -> Any:
    return jax.ShapeDtypeStruct(shape, dtype)


def _described(tree: Any) -> str:
    """Structure, dtypes and shapes, in words."""
    return str(jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", tree)).replace("'", "")
