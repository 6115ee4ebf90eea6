"""Commands that are interrupted in any phase: one line, the signal's code, nothing lost."""

import json
import signal

import pytest

from agents.runs.loading import save
from helpers import small_runs
from helpers.tiny_policy import random_policy

ENDLESS = [*small_runs.options(), "--iterations", 1_000_000, "--sets", "base"]
SHORT = [*small_runs.options(), "--iterations", 1]
GRID = ["--settings", *(f"{k}={json.dumps(v)}" for k, v in small_runs.SETTINGS.items())]
RESUME = "Stopped. Continue with: python -m agents.train --resume "
AGAIN = "Stopped. The same command starts again."
CONTINUES = "Stopped. The same command continues."

# Command, arguments, the beginning of a line that tells the phase, the stream, and the last line.
PHASES = {
    "compiling": ("agents.train", [*ENDLESS, "--name", "x"], "", "stdout", RESUME),
    "training": ("agents.train", [*ENDLESS, "--name", "x"], "iteration 1", "stdout", RESUME),
    "evaluation": ("agents.train", [*SHORT, "--name", "x"], "Playing", "stdout", RESUME),
    "start of a sweep": ("agents.sweep", GRID, "1 run(s)", "stdout", CONTINUES),
    "table of a sweep": (
        "agents.sweep",
        [*GRID, "iterations=1"],
        "[1/1]",
        "stdout",
        CONTINUES,
    ),
    "evaluate": ("agents.evaluate", ["POLICY", "--import", "says_ready"], "ready", "stdout", AGAIN),
    "solver": ("trap_tube_jax.solver", ["--tasks", 100_000], "Solving", "stderr", AGAIN),
}
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("phase", PHASES)
def test_an_interrupted_command_says_how_to_go_on(phase, times, tmp_path):
    module, arguments, line, stream, last = PHASES[phase]
    number = SIGNALS[(list(PHASES).index(phase) + times) % len(SIGNALS)]
    (tmp_path / "says_ready.py").write_text("print('ready', flush=True)")
    save(tmp_path / "policy.safetensors", random_policy())
    given = [tmp_path / "policy.safetensors" if x == "POLICY" else x for x in arguments]
    if module.startswith("agents") and module != "agents.evaluate":
        given += ["--out", tmp_path]
    process = small_runs.start(module, *given, cwd=tmp_path)
    source = getattr(process, stream)
    while not (found := source.readline()).startswith(line):
        assert found, process.communicate()
    for _ in range(times):
        process.send_signal(number)
    assert process.stderr is not None
    errors = process.stderr.read()
    process.communicate()
    assert process.returncode == 128 + number, errors
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].startswith(last)
    if module == "agents.train":
        trained, _ = small_runs.final_state(tmp_path / "x")
        assert trained >= (phase == "training" and times == 1), "saved"
