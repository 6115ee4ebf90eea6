"""Programs for accelerators, of which the machine that runs the tests may have none."""

from typing import Any

import jax
import pytest

import trap_tube_jax as tt
from agents import Config, make_train

PLATFORMS = ("cpu", "cuda", "tpu")
TINY = Config(
    env_id="pstsy", max_steps=4, episodes=4, minibatch=2, epochs=1, filters=(2, 3), hidden=4,
    embedding=2, chunk=4,
).to_dict()  # fmt: skip
DAGGER = {
    "method": "dagger", "curiosity": "none", "encoder": "objects", "tasks": 2, "walkers": 4,
    "walk_rounds": 1, "walk_steps": 4, "agent_rounds": 1, "dataset": 8,
}  # fmt: skip


def lowered_for(function: Any, *arguments: Any) -> tuple[str, ...]:
    exported = jax.export.export(jax.jit(function), platforms=PLATFORMS)(*arguments)
    assert exported.mlir_module_serialized
    return exported.platforms


def test_the_environment_lowers_for_accelerators():
    env = tt.make("pstsy")
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 2))
    assert lowered_for(jax.vmap(env.reset), keys) == PLATFORMS


@pytest.mark.parametrize(
    "settings", [{}, {"curiosity": "rnd"}, DAGGER], ids=["icm", "rnd", "dagger"]
)
def test_training_lowers_for_accelerators(settings):
    train = make_train(Config.from_dict({**TINY, **settings}))
    state = jax.eval_shape(train.init, jax.random.key(0))
    assert lowered_for(train.iterate, state) == PLATFORMS
