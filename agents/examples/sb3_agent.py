"""Trains PPO of Stable-Baselines3 and scores it; needs the extra `interop`.

python -m agents.examples.sb3_agent
"""

import argparse

import trap_tube_jax as tt
from agents.examples.near_food import NEAR_FOOD
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import needs_extra


def main(total_timesteps: int = 3_000) -> tt.Scores:
    """Trains on `NEAR_FOOD`; scores on this set and on base, which training never plays."""
    with needs_extra("interop"):
        import stable_baselines3  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
        import torch  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

        from trap_tube_jax.adapters.to_gymnasium import TrapTubeEnv  # noqa: PLC0415
    torch.set_num_threads(1)  # otherwise its threads and JAX's wait for each other
    env = TrapTubeEnv(NEAR_FOOD.id)
    model = stable_baselines3.PPO(
        "MlpPolicy", env, n_steps=256, batch_size=64, learning_rate=1e-3, seed=0, device="cpu"
    )
    model.learn(total_timesteps)
    scores = tt.score_gymnasium(model, sets=[NEAR_FOOD.short, "base"])
    print(scores)
    return scores


if __name__ == "__main__":
    argparse.ArgumentParser(
        "python -m agents.examples.sb3_agent",
        description="Trains PPO of Stable-Baselines3 and scores it.",
    ).parse_args()
    with plain_errors():
        main()
