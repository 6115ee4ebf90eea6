"""Commands that are interrupted in any phase: one line, the signal's code, nothing lost."""

import json
import signal
from typing import Any

import pytest

from agents.runs.loading import save
from helpers import small_runs
from helpers.tiny_policy import random_policy

ENDLESS = [*small_runs.options(), "--iterations", 1_000_000, "--sets", "base"]
SHORT = [*small_runs.options(), "--iterations", 1]
GRID = ["--settings", *(f"{k}={json.dumps(v)}" for k, v in small_runs.SETTINGS.items())]
POLICY = ["policy.safetensors", "--import", "says_ready"]
RESUME = "Stopped. Continue with: python -m agents.train --resume runs/x"
AGAIN = "Stopped. The same command starts again."
CONTINUES = "Stopped. The same command continues."

# Command, arguments, the beginning of a line that tells the phase, and the last line.
PHASES = {
    "compiling": ("agents.train", [*ENDLESS, "--name", "x"], "runs/x: ", RESUME),
    "training": ("agents.train", [*ENDLESS, "--name", "x"], "iteration 1", RESUME),
    "evaluation": ("agents.train", [*SHORT, "--name", "x"], "Playing", RESUME),
    "report": ("agents.train", [*SHORT, "--name", "x"], "Drawing", RESUME),
    "start of a sweep": ("agents.sweep", GRID, "1 run(s)", CONTINUES),
    "a sweep": ("agents.sweep", [*GRID, "iterations=1000000"], "0% of 1 run(s)", CONTINUES),
    "table of a sweep": ("agents.sweep", [*GRID, "iterations=1"], "[1/1]", CONTINUES),
    "named grid": ("agents.experiments", ["fast", "--seeds", 1, *GRID], "1 run(s)", CONTINUES),
    "evaluate": ("agents.evaluate", POLICY, "ready", AGAIN),
    "profile": ("agents.profile", [*POLICY, "--parts", "kind", "--tasks", 2], "ready", AGAIN),
    "solver": ("trap_tube_jax.solver", ["--tasks", 100_000], "Solving", AGAIN),
    "benchmark": ("benchmarks.env_throughput", ["--repeats", 1_000_000], "{", AGAIN),
}


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_an_interrupted_command_says_how_to_go_on(phase, tmp_path):
    """By Ctrl-C; other signals, and a second one, have the same way."""
    module, arguments, begins, last = PHASES[phase]
    (tmp_path / "says_ready.py").write_text("print('ready', flush=True)")
    save(tmp_path / "policy.safetensors", random_policy())
    with small_runs.start(module, *arguments, cwd=tmp_path) as process:
        stream: Any = process.stderr if phase == "solver" else process.stdout
        while not (line := stream.readline()).startswith(begins):
            assert line, process.communicate()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 128 + signal.SIGINT, errors
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].startswith(last), errors
    if phase == "training":
        assert small_runs.final_state(tmp_path / "runs" / "x")[0] >= 1, "saved"
