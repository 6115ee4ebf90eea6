"""Reads the recorded update of the published baseline into this project's layout.

In the recording `move` names action component 0, the grasp, and `grasp` component 1.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.episodes import Episodes, cells_of
from agents.acting.rollout import Trajectory
from agents.acting.symmetry import Symmetry
from agents.networks.agent import Agent, Params
from trap_tube_jax.objects import AGENT, BASE_COLORS, FOOD, GROUND, TOOL, TUBE1

PARAMETER_NAMES = {
    "encoder/conv1": "conv1",
    "encoder/conv2": "conv2",
    "encoder/block1/conv1": "residual_block1/conv1",
    "encoder/block1/conv2": "residual_block1/conv2",
    "encoder/block2/conv1": "residual_block2/conv1",
    "encoder/block2/conv2": "residual_block2/conv2",
    "core/grasp_embedding/embedding": "move_embedding/embeddings",
    "core/move_embedding/embedding": "grasp_embedding/embeddings",
    "core/reward_embedding": "reward_embedding",
    "core/mix": "dense_hidden",
    "core/input_kernel": "rnn/kernel",
    "core/state_kernel": "rnn/recurrent_kernel",
    "core/bias": "rnn/bias",
    "core/initial": "initial_hidden_state",
    "heads/grasp": "move_logits",
    "heads/move": "grasp_logits",
    "heads/value": "values_logits",
    "curiosity/forward": "dense_forward",
    "curiosity/inverse": "dense_inverse",
    "curiosity/inverse_grasp": "dense_inverse_move",
    "curiosity/inverse_move": "dense_inverse_grasp",
}


@dataclasses.dataclass(frozen=True)
class Recording:
    """The arrays of the recording by name."""

    arrays: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        """The array as recorded."""
        return self.arrays[name]

    def params(self, prefix: str, like: Params) -> Params:
        """The parameters (or gradients) under `prefix`, in the structure of `like`."""

        def convert(path: Any, leaf: jax.Array) -> jax.Array:
            name = jax.tree_util.keystr(path, simple=True, separator="/").replace("/params/", "/")
            if name not in PARAMETER_NAMES:
                module, _, kind = name.rpartition("/")
                recorded = f"{PARAMETER_NAMES[module]}/{kind}"
            else:
                recorded = PARAMETER_NAMES[name]
            return jnp.asarray(self.arrays[f"{prefix}/{recorded}"].reshape(leaf.shape))

        return jax.tree_util.tree_map_with_path(convert, like)


def parse_state(image: np.ndarray) -> tt.State:
    """The state that a picture in base colours shows, the tool wholly visible."""
    colors = BASE_COLORS.tolist()
    codes = np.array([[colors.index(color) for color in row] for row in image.tolist()])
    board = np.where(codes < FOOD, codes, GROUND)
    tool = np.argwhere(codes == TOOL)
    return tt.State.create(
        board=np.where(board == TUBE1 + 1, TUBE1, board),
        agent=np.argwhere(codes == AGENT)[0],
        tool=tool[0],
        tool_extent=tool[-1] - tool[0] + 1,
        food=np.argwhere(codes == FOOD)[0],
    )


def replay(initial: tt.State, action: jax.Array) -> jax.Array:
    """The cells u8[T + 1, 3, 2] of an episode under actions i32[T, 2]."""
    env = tt.Environment()

    def body(state: tt.State, action_t: jax.Array) -> tuple[tt.State, jax.Array]:
        state, _ = env.step(state, action_t)
        return state, cells_of(state)

    _, after = jax.lax.scan(body, initial, action)
    return jnp.concatenate([cells_of(initial)[None], after])


def make_trajectory(agent: Agent, params: Params, recording: Recording) -> Trajectory:
    """The recorded episodes as the agent with `params` would have stored them."""
    images = recording["batch/observation_rgb"]
    states = [parse_state(image) for image in images[:, 0]]
    initial = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    action = jnp.asarray(recording["batch/action"], jnp.int32)
    reward = jnp.asarray(recording["batch/reward"])
    features = jax.vmap(lambda image: agent.encode(params, image))(jnp.asarray(images))
    hidden, _ = agent.unroll(params, features, action, reward)
    actions, value = agent.policy_and_value(params, hidden)
    return Trajectory(
        symmetry=Symmetry.from_index(jnp.zeros(len(action), jnp.int32)),
        episodes=Episodes(
            layout=initial,
            cells=jax.vmap(replay)(initial, action),
            action=action,
            reward=reward,
            discount=jnp.full_like(reward, 1e9),  # which the baseline does not look at
            mask=jnp.asarray(recording["batch/weight"]),
        ),
        log_prob=actions.log_prob(action),
        value=jnp.concatenate([value, jnp.full_like(value[:, :1], 1e9)], axis=1),
    )
