"""Uses the installed wheel without extras, outside the checkout."""

import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp

import trap_tube_jax as tt

SAVE_BOARD = """
import trap_tube_jax as tt

tt.save_gif(tt.render(tt.base_state(), 8)[None], "board.gif")
"""


class Random:
    """Draws its actions."""

    def initial(self, batch):
        """Remembers nothing."""
        return ()

    def act(self, observation, carry, key):
        """Returns uniform actions."""
        return jax.random.randint(key, (len(observation), 2), 0, 4), carry


def play():
    """Resets, steps, renders, solves and scores."""
    env = tt.make("PerceptualTrapTube-v0")
    state, _ = env.reset(jax.random.key(0))
    state, timestep = env.step(state, jnp.array([0, 3]))
    assert timestep.observation.shape == (12, 12, 3)
    assert tt.render(state, 8).shape == (96, 96, 3)
    assert tt.solve(tt.base_state()).length == 11
    assert [score.tasks for score in tt.score(Random(), ["base", "p"], 16).sets] == [1, 16]


def run_alone():
    """Finds nothing that the wheel does not need, and says what GIFs need."""
    for module in ("agents", "benchmarks", "pandas", "PIL", "matplotlib"):
        assert importlib.util.find_spec(module) is None, module
    play()
    survey = ["-m", "trap_tube_jax.solver", "--sets", "base", "--tasks", "1"]
    subprocess.run([sys.executable, *survey], check=True)
    gif = [sys.executable, "-c", SAVE_BOARD]
    result = subprocess.run(gif, capture_output=True, text=True, check=False)
    assert "pip install 'trap-tube-jax[pictures]'" in result.stderr.splitlines()[-1]


if __name__ == "__main__":
    run_alone()
