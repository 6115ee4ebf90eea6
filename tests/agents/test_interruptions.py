"""Commands that are interrupted in any phase: one line, the signal's code, nothing lost."""

import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
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
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
SILENT = ("a sweep", "solver", "benchmark")  # so they do not see that a pipe is closed


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_an_interrupted_command_says_how_to_go_on(phase, tmp_path):
    """By every signal, once and twice, and by a closed pipe."""
    with ExitStack() as stack:
        started = {}
        for number, times in ends(phase):
            folder = tmp_path / f"{number.name}-{times}"
            started[number, times] = stack.enter_context(start(phase, folder)), folder
        for (number, times), (process, folder) in started.items():
            await_line(phase, process)
            errors = interrupt(process, number, times)
            check_end(phase, number, process.returncode, errors)
            if phase == "training" and times == 1:
                assert small_runs.final_state(folder / "runs" / "x")[0] >= 1, "saved"


def ends(phase: str) -> Iterator[tuple[signal.Signals, int]]:
    """Yields what ends a process, and how often it is sent."""
    for number in SIGNALS:
        yield number, 1
        yield number, 2
    if phase not in SILENT:
        yield signal.SIGPIPE, 1


def start(phase: str, folder: Path) -> Any:
    module, arguments, *_ = PHASES[phase]
    folder.mkdir()
    (folder / "says_ready.py").write_text("print('ready', flush=True)")
    save(folder / "policy.safetensors", random_policy())
    return small_runs.start(module, *arguments, cwd=folder)


def await_line(phase: str, process: Any) -> None:
    stream = process.stderr if phase == "solver" else process.stdout
    while not (line := stream.readline()).startswith(PHASES[phase][2]):
        assert line, process.communicate()


def interrupt(process: Any, number: signal.Signals, times: int) -> str:
    """Returns what the process writes to stderr from then on to its end."""
    if number == signal.SIGPIPE:
        process.stdout.close()
        process.stdout = None
    else:
        for _ in range(times):
            process.send_signal(number)
    return process.communicate()[1]


def check_end(phase: str, number: signal.Signals, code: int, errors: str) -> None:
    assert code == 128 + number, errors
    assert "Traceback" not in errors
    last = PHASES[phase][-1]
    if number == signal.SIGPIPE and last == AGAIN:  # as in `command | head -1`
        assert "Stopped" not in errors
    else:
        assert errors.splitlines()[-1].startswith(last), errors
