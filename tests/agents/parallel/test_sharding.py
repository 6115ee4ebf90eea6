"""Several devices and several processes: the same training as on one, or a clear refusal."""

import json
import os
import re
import signal
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

from agents.acting.rollout import greedy_action
from agents.config import Config
from agents.parallel import processes
from agents.parallel.sharding import Placement, Shards
from agents.runs.checkpoint import Checkpoints
from agents.runs.metrics import read_metrics
from agents.train import main
from paths import ROOT
from refusal import refused

SETTINGS = [
    *(
        "--episodes-per-iteration",
        "8",
        "--minibatch-size",
        "4",
        "--epochs",
        "1",
        "--max-steps",
        "4",
        "--encode-chunk-size",
        "8",
    ),
    *("--filters", "2", "2", "--hidden", "4", "--embedding", "2", "--eval-episodes", "1"),
    *("--curiosity", "none", "--iterations", "100000"),
]


def start(*command, devices=1):
    return subprocess.Popen(
        [sys.executable, "-W", "error", *map(str, command)],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "JAX_PLATFORMS": "cpu",
            "JAX_NUM_CPU_DEVICES": str(devices),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    """What `sharded_training` found on eight devices."""
    folder = tmp_path_factory.mktemp("eight")
    process = start(ROOT / "tests" / "sharded_training.py", folder, devices=8)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    return json.loads(output)


@pytest.mark.slow
def test_eight_devices_train_as_one(eight):
    assert eight["mesh"] == {"seeds": 2, "episodes": 4}
    assert eight["learned"] > 1e-3
    assert eight["state"]["gap"] < 2e-6, eight["state"]
    for metrics in eight["metrics"]:
        assert metrics["gap"] < 2e-6, metrics


@pytest.mark.slow
def test_eight_devices_evaluate_as_one(eight):
    assert eight["tasks"] == {"base": 1, "st": 3}
    assert eight["evaluation"]


@pytest.mark.slow
def test_checkpoints_move_between_numbers_of_devices(eight):
    assert eight["eight_to_one"]["gap"] < 2e-6, eight["eight_to_one"]
    assert eight["eight_to_eight"]


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """The folder of a run of two processes."""
    return tmp_path_factory.mktemp("joint") / "run"


def start_two(folder, *arguments):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = ["-m", "agents.train", "--name", folder.name, *arguments, "--checkpoint-every", 1]
    command += ["--keep", 1, "--coordinator", address, "--processes", 2]
    return [
        start(*command, "--process-id", number, "--out", out)
        for number, out in enumerate((folder.parent, folder.parent / "unseen"))
    ]


def wait_for_iterations(process, count):
    while count and (line := process.stdout.readline()):
        count -= bool(re.match(r"\s+\d+ .*left at most", line))


def checkpoint(folder):
    with Checkpoints(folder / "checkpoints") as checkpoints:
        arrays, record = checkpoints.load()
        assert checkpoints.iterations == [record["iteration"]] == arrays["iteration"].tolist()
    return record["iteration"]


def without_transport(text):
    """Output without what the collectives' library says of its connections."""
    return "".join(line for line in text.splitlines(True) if not line.startswith("[Gloo]"))


@pytest.mark.slow
def test_two_processes_stop_together(joint):
    first, second = start_two(joint, *SETTINGS)
    wait_for_iterations(first, 2)
    second.send_signal(signal.SIGTERM)
    (output, errors), (silence, complaints) = first.communicate(), second.communicate()
    assert (first.returncode, second.returncode) == (143, 143), errors + complaints
    assert without_transport(silence + errors + complaints) == ""
    assert not (joint.parent / "unseen").exists()
    match = re.search(r"Stopped at iteration (\d+)\. Continue with: ", output)
    assert match
    iteration = int(match[1])
    assert checkpoint(joint) == iteration >= 2
    rows = read_metrics(joint / "metrics.csv")
    assert [row["iteration"] for row in rows] == list(range(1, iteration + 1))
    assert [row["episodes"] for row in rows] == list(range(8, 8 * iteration + 1, 8))


@pytest.mark.slow
def test_a_killed_process_ends_the_other(joint):
    """In the run that the test above has left: two processes take it up."""
    before = checkpoint(joint)
    first, second = start_two(joint, "--resume")
    wait_for_iterations(first, 2)
    second.kill()
    _, errors = first.communicate()
    second.communicate()
    assert first.returncode not in (0, None)
    assert "another process" in errors or "another task died" in errors
    assert "Traceback" not in errors
    assert checkpoint(joint) >= before + 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--devices 2", "2 devices cannot share minibatch="),
        ("--devices 0", "are there; allowed: 1"),
        ("--coordinator a:1", "coordinator, processes and process_id belong together"),
        ("--coordinator a --processes 2 --process-id 0", "coordinator must be HOST:PORT, got 'a'"),
        ("--coordinator a:1 --processes 2 --process-id 2", "process_id must lie in [0, 1], got 2"),
        ("--coordinator a:1 --processes 0 --process-id 0", "processes must be >= 1, got 0"),
        ("--peer-timeout 0", "peer_timeout must be >= 1, got 0"),
    ],
)
def test_impossible_devices_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, main, *arguments.split(), "--out", tmp_path)
    assert not list(tmp_path.iterdir())


def test_uneven_shares_are_refused(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: 12 * jax.local_devices())
    monkeypatch.setattr(jax, "local_device_count", lambda: 12)
    config = Config(episodes_per_iteration=16, minibatch_size=8)
    with pytest.raises(ValueError, match=r"^12 devices cannot .* allowed: 1, 2, 4, 8$"):
        Placement.of("all", config, seeds=1)
    with pytest.raises(ValueError, match=r"^5 devices cannot .* allowed: 1, 2, 3, 4, 6, 8, 12$"):
        Placement.of(5, config, seeds=3)


def test_one_shard_is_no_work():
    x = np.arange(6.0)
    alone = Shards()
    assert alone.part(x) is alone.whole(x) is alone.mean(x) is x
    assert alone.drawing(greedy_action) is greedy_action
    assert Placement.of(None, Config(), 3) == Placement()
    assert processes.from_first(lambda: 3) == 3
    assert processes.agree(None) is None
