"""Uses the installed wheel without extras, outside the checkout."""

import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp

import trap_tube_jax as tt


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
    """Finds nothing that the wheel does not need, and says in a line what pictures need."""
    for module in ("agents", "benchmarks", "pandas", "PIL", "matplotlib"):
        assert importlib.util.find_spec(module) is None, module
    play()
    for command, code in (
        (["gallery"], 2),
        (["solver", "--show", "base"], 0),
        (["solver", "--sets", "base", "--tasks", "1"], 0),
    ):
        result = run(*command)
        assert result.returncode == code, result
        assert "pip install 'trap-tube-jax[pictures]'" in result.stderr.splitlines()[-1]


def run(*arguments):
    """Runs one of the package's command lines."""
    name, *rest = arguments
    command = [sys.executable, "-m", f"trap_tube_jax.{name}", *rest]
    return subprocess.run(command, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    run_alone()
