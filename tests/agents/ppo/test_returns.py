"""The rules of bootstrap at the end of an episode."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.ppo import advantages

TERMINATED = ([1, 0, 0], [1, 1, 0])
TRUNCATED = ([1, 1, 1], [1, 1, 1])


@pytest.mark.parametrize(
    ("bootstrap", "end", "advantage", "target"),
    [
        # Nothing follows a terminated episode; the last observation's value a truncated one.
        ("value", TERMINATED, [1 + 0.5 * 20 - 10, 1 - 20, 0], [11, 1]),
        ("value", TRUNCATED, [1, -4, 1 + 0.5 * 40 - 30], [11, 16, 21]),
        # After termination the value of the board that stays, after truncation the last step's.
        ("baseline", TERMINATED, [1, 1 + 0.5 * 30 - 20, 0], [1.5, 1, 0]),
        ("baseline", TRUNCATED, [1, -4, 1 + 0.5 * 30 - 30], [1.75, 1.5, 1]),
    ],
)
def test_the_rules_of_bootstrap_differ_at_the_end(bootstrap, end, advantage, target):
    """Rewards are 1, values 10, 20, 30, 40."""
    config = Config(discount=0.5, gae_lambda=0.0, bootstrap=bootstrap)
    nothing: Any = None
    discount, mask = (jnp.array(x, jnp.float32)[None] for x in end)
    episodes = Episodes(nothing, nothing, nothing, nothing, discount, mask)
    value = jnp.array([[10.0, 20.0, 30.0, 40.0]])
    found = advantages.advantages_and_targets(config, mask, episodes, value)
    np.testing.assert_allclose(found[0][0], advantage)
    np.testing.assert_allclose(found[1][0, : len(target)], target)
