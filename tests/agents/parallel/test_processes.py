"""Several processes train one run: they join, stop together, and leave files that one can read."""

import re
import signal
import socket

import pytest

from agents.runs import checkpoint
from agents.runs.metrics import read_rows
from agents.train import main
from helpers.refusal import refused
from helpers.small_runs import options, start
from trap_tube_jax.interruptions import FINISHING


def without_gloo(text):
    """Returns output without the lines of the library that connects processes."""
    return "".join(line for line in text.splitlines(True) if not line.startswith("[Gloo]"))


def start_two(tmp_path, iterations):
    """Starts both processes of a run in the folder "joint"."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [*options(), "--iterations", iterations, "--checkpoint-every", 1]
    command += ["--out", tmp_path, "--name", "joint", "--sets", "base", "p"]
    return [start("agents.train", *command, "--distributed", address, 2, i) for i in range(2)]


@pytest.mark.slow
def test_two_processes_end_together_and_the_first_reports(tmp_path):
    ended = [(process.communicate(), process.returncode) for process in start_two(tmp_path, 2)]
    assert [code for _, code in ended] == [0, 0], ended
    rows = read_rows(tmp_path / "joint" / "evaluations.csv")
    assert rows["task_set"].tolist() == ["base", "p"]
    assert (tmp_path / "joint" / "report.html").exists()


@pytest.mark.slow
def test_two_processes_stop_together_and_one_continues(tmp_path):
    first, second = start_two(tmp_path, 100_000)
    assert first.stdout is not None
    while not re.match("iteration 2 of", line := first.stdout.readline()):
        assert line, first.communicate()
    second.send_signal(signal.SIGTERM)
    (_, hint) = map(without_gloo, first.communicate())
    (silence, notice) = map(without_gloo, second.communicate())
    assert (first.returncode, second.returncode) == (143, 143), hint + notice
    assert re.fullmatch("Stopped. Continue with: .+ --resume .+/joint\n", hint)
    assert (silence, notice) == ("", f"{FINISHING}\n")

    folder = tmp_path / "joint"
    iteration = checkpoint.iterations(folder / "checkpoints")[-1]
    episodes = read_rows(folder / "metrics.csv")["episodes"]
    assert episodes.tolist() == [8 * done for done in range(1, iteration + 1)]

    alone = start("agents.train", "--resume", folder, "--iterations", iteration + 1)
    _, errors = alone.communicate()
    assert alone.returncode == 0, errors
    assert len(read_rows(folder / "metrics.csv")) == iteration + 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--devices 2", "2 of 1 cpu devices in 1 process(es) cannot share"),
        ("--devices 0", "devices must be an integer >= 1"),
        ("--distributed", "cannot join the other processes"),
        ("--distributed a:1", "else --distributed HOST:PORT PROCESSES NUMBER"),
    ],
)
def test_impossible_devices_and_processes_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, main, *arguments.split(), "--out", tmp_path)
