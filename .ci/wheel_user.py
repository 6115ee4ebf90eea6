"""Uses the installed wheel outside the checkout, `alone` or with `extras`."""

import importlib.util
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

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
    """Finds nothing that the wheel does not need, and refuses pictures in a line."""
    for module in ("agents", "benchmarks", "pandas", "PIL", "matplotlib"):
        assert importlib.util.find_spec(module) is None, module
    play()
    for command in (["gallery"], ["solver", "--show", "base"], ["solver", "--tasks", "1"]):
        result = run(*command)
        assert result.returncode == 2, result
        assert result.stderr.count("\n") == 1, result.stderr
        assert "pip install 'trap-tube-jax[pictures]'" in result.stderr


def run_with_extras():
    """Writes pictures, and steps Gymnasium's environments."""
    for command, file in (
        (["gallery"], "gallery.png"),
        (["solver", "--show", "base"], "plan.gif"),
        (["solver", "--sets", "base", "--tasks", "1"], "shortest_plans.png"),
    ):
        run(*command).check_returncode()
        assert pathlib.Path(file).stat().st_size > 1000
    import gymnasium  # noqa: PLC0415

    batch = gymnasium.make_vec("trap_tube_jax/PerceptualTrapTube-v0", num_envs=2)
    batch.reset(seed=0)
    observation, *_ = batch.step(np.array([[0, 3], [1, 2]]))
    assert observation.shape == (2, 12, 12, 3)


def run(*arguments):
    """Runs one of the package's command lines."""
    name, *rest = arguments
    command = [sys.executable, "-m", f"trap_tube_jax.{name}", *rest]
    return subprocess.run(command, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    {"alone": run_alone, "extras": run_with_extras}[sys.argv[1]]()
