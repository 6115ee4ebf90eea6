"""Trains rejax's PPO and scores it; needs the extra `interop`.

python -m agents.examples.rejax_agent
"""

import argparse
from collections.abc import Callable

import jax

import trap_tube_jax as tt
from agents.examples.near_food import NEAR_FOOD
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import needs_extra


class Policy:
    """Wraps a function of (u8[12, 12, N], key) that returns 4 * grasp + move, for `tt.score`."""

    def __init__(self, act: Callable[[jax.Array, jax.Array], jax.Array]):
        self._act = act

    def initial(self, batch: int) -> tuple[()]:
        """Returns no memory."""
        del batch
        return ()

    def act(
        self, observation: jax.Array, carry: tuple[()], key: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """Returns actions i32[B, 2] for observations u8[B, 12, 12, N]."""
        index = jax.vmap(self._act)(observation, jax.random.split(key, len(observation)))
        return tt.action_from_index(index), carry


def main(total_timesteps: int = 8_192) -> tt.Scores:
    """Trains on `NEAR_FOOD`; scores on this set and on base, which training never plays."""
    with needs_extra("interop"):
        import rejax  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

        from trap_tube_jax.adapters import to_gymnax  # noqa: PLC0415
    env, params = to_gymnax.make(NEAR_FOOD.id)
    ppo = rejax.PPO.create(
        env=env,
        env_params=params,
        total_timesteps=total_timesteps,
        eval_freq=total_timesteps,
        num_envs=32,
        num_steps=32,
        num_minibatches=4,
        learning_rate=1e-3,
        normalize_observations=True,
    )
    trained, _ = jax.jit(ppo.train)(jax.random.PRNGKey(0))
    scores = tt.score(Policy(ppo.make_act(trained)), sets=[NEAR_FOOD.short, "base"])
    print(scores)
    return scores


if __name__ == "__main__":
    argparse.ArgumentParser(
        "python -m agents.examples.rejax_agent", description="Trains rejax's PPO and scores it."
    ).parse_args()
    with plain_errors():
        main()
