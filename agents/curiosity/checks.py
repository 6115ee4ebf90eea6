"""Makes curiosities, and checks that they keep their contract, so that the learner need not."""

from typing import Any

import chex
import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks.layers import assert_floats, draw
from agents.registry import contract, curiosities
from trap_tube_jax.objects import BOARD_SIZE

TAKEN = ("policy_loss", "value_loss", "entropy_loss", "motion_loss")  # terms of the learner's loss


def make_curiosity(config: Config, env: tt.Environment) -> Curiosity:
    """Builds the curiosity that `config.curiosity` names, for training in `env`.

    Raises:
      ValueError: a registered curiosity breaks its contract.
    """
    return CheckedCuriosity(config, curiosities.factory(config.curiosity)(config, env))


class CheckedCuriosity(Curiosity):
    """A curiosity whose results are checked while they are traced.

    Methods raise ValueError with the curiosity's name.
    """

    def __init__(self, config: Config, curiosity: Curiosity):
        """Checks the curiosity's parameters and features.

        Raises:
          ValueError: it is no `Curiosity`, or breaks the contract.
        """
        self.name = config.curiosity
        self.curiosity = curiosity
        with contract("curiosity", self.name):
            kind = type(curiosity).__name__
            assert isinstance(curiosity, Curiosity), f"{kind} is no agents.curiosity.Curiosity"
            boards = jnp.zeros((2, BOARD_SIZE, BOARD_SIZE, config.num_features), jnp.uint8)
            params = jax.eval_shape(self.init, jax.random.key(0), boards[:1])
            assert_floats(params)
            features = jax.eval_shape(curiosity.encode, params, boards)
            assert isinstance(features, jax.ShapeDtypeStruct), "encode must return an array"
            chex.assert_shape(features, (len(boards), None))
            chex.assert_type(features, jnp.float32)
        self.needs_next_hidden = curiosity.needs_next_hidden
        self.memory = curiosity.memory
        self.encode = curiosity.encode

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters; see `Curiosity.init`.

        Also draws the kernels of `layers.dense` that a module's own `init` left undrawn.
        """
        return draw(jax.random.fold_in(key, 1), self.curiosity.init(key, board))

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns reward and memory; see `Curiosity.reward`."""
        with contract("curiosity", self.name):
            returned = self.curiosity.reward(params, memory, experience)
            assert_like(returned, (experience.episodes.mask, memory))
        return returned

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Returns terms of the loss; see `Curiosity.losses`."""
        with contract("curiosity", self.name):
            found = self.curiosity.losses(params, experience)
            assert isinstance(found, dict), f"losses are {type(found).__name__}, not a dict"
            wrong = [name for name in found if name in TAKEN or not name.endswith("_loss")]
            assert not wrong, (
                f"names of losses must end in '_loss' and differ from {', '.join(TAKEN)}; "
                f"got {', '.join(wrong)}"
            )
            assert_like(found, dict.fromkeys(found, experience.episodes.mask))
        return found


def assert_like(returned: Any, wanted: Any) -> None:
    """Raises AssertionError unless two trees agree in structure, shapes and dtypes."""
    shapes = jax.eval_shape(lambda: returned)
    chex.assert_trees_all_equal_shapes_and_dtypes(shapes, wanted)
