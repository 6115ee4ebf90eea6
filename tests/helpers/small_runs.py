"""Training so small that it takes a second, and the processes and files of its runs."""

import csv
import math
import os
import subprocess
import sys

from agents.config import Config
from agents.runs import checkpoint
from agents.runs.folder import RunFolder
from agents.runs.metrics import append_rows
from helpers.paths import ROOT

SETTINGS = {
    "episodes_per_iteration": 8,
    "minibatch_size": 4,
    "epochs": 1,
    "max_steps": 6,
    "filters": (2, 2),
    "hidden": 4,
    "embedding": 2,
    "eval_episodes": 2,
}
TIMING_COLUMNS = (
    "seconds",
    "transitions_per_second",
)  # differ between equal runs


def small_config(**settings):
    """Returns the preset `fast` at its smallest, which solves nothing."""
    return Config.preset("fast", **{**SETTINGS, **settings})


def options():
    """Returns the settings as options of a command line."""
    given = []
    for name, value in SETTINGS.items():
        values = value if isinstance(value, tuple) else (value,)
        given += [f"--{name.replace('_', '-')}", *map(str, values)]
    return given


def start(module, *arguments, cwd=ROOT, **environment):
    """Starts a process of a command line, warnings being errors."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    # On a busy machine, XLA's log complains about slow compilation.
    fixed = {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "3"}
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", module, *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, **fixed, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(module, *arguments, **environment):
    """Runs a command line to its end, and returns its output.

    On stderr it may only say what takes long.
    """
    process = start(module, *arguments, **environment)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert all(line.endswith(" ...") for line in errors.splitlines()), errors
    return output


def read_iterations(process, count):
    """Reads the output up to the line of the count-th iteration, or to its end."""
    while count and (line := process.stdout.readline()):
        count -= line.startswith("iteration ")


def untimed(folder):
    """Returns the metrics of a run without the columns of time."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in rows]


def final_state(folder):
    """Returns the iteration and the bytes of the arrays of the newest checkpoint."""
    arrays, record = checkpoint.load(folder / "checkpoints")
    return record["iteration"], {name: array.tobytes() for name, array in arrays.items()}


def stored_run(path, run, metrics=(), evaluations=(), options=None):
    """Writes the settings of a run, and rows of its files; returns its folder."""
    folder = RunFolder(path)
    folder.write_config(run, options)
    append_rows(folder.metrics, metrics)
    append_rows(folder.evaluations, evaluations)
    return folder


def metrics_row(iteration, **values):
    """Returns a row of metrics, with some values replaced."""
    counts = {"episodes": 8 * iteration, "transitions": 48 * iteration, "seconds": 1.0}
    shares = {"success": 0.25, "validation_success": 0.5, "loss": math.nan, "policy_loss": math.nan}
    rate = {"transitions_per_second": 6000.0, "intrinsic_reward": 0.1}
    return {"iteration": iteration, **counts, **shares, **rate, **values}
