"""Uses an extra as the page that names it does: `extra_user.py EXTRA FOLDER`, in the checkout.

Runs in FOLDER. The wheel is used as installed, `agents` and `benchmarks` from the checkout.
"""

import os
import pathlib
import re
import subprocess
import sys

ADAPTERS = "trap_tube_jax/adapters/README.md"
PDOC = ["-W", "error", "-m", "pdoc", "--docformat", "google", "-o", "reference"]
TRAIN = ["-m", "agents.train", "--iterations", "1", "--episodes-per-iteration", "64"]
SWEEP_ON_A_CLUSTER = """
import subprocess, sys
from distributed import LocalCluster

with LocalCluster(n_workers=1, threads_per_worker=1) as cluster:
    command = "-m agents.sweep --settings iterations=1 episodes_per_iteration=64 --seeds 1".split()
    address = ["--cluster", cluster.scheduler_address]
    subprocess.run([sys.executable, *command, *address], check=True)
"""
COMPARE_PEERS = """
from benchmarks import peers
from benchmarks.env_throughput import task_set_subject

options = peers.Options(sets=("base",), num_envs=(2,), num_steps=2, repeats=1)
_, skipped = peers.measure(options, [task_set_subject("base")])
assert not skipped, skipped
"""
SAVE_PLAN = """
import trap_tube_jax as tt

state = tt.base_state()
tt.save_gif(tt.episode_frames(state, tt.solve(state).actions), "plan.gif")
"""
WHEEL_ALONE = ("pictures", "gymnasium", "gymnax")


def block(page: str, mark: str) -> str:
    """Returns the first Python block of a page that holds `mark`."""
    text = pathlib.Path(page).read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return next(code for code in found if mark in code)


USES = {
    "pictures": [["-c", SAVE_PLAN]],
    "gymnasium": [["-c", block(ADAPTERS, "import gymnasium")]],
    "gymnax": [["-c", block(ADAPTERS, "to_gymnax")]],
    "agents": [["-c", block("README.md", "from agents")]],
    "agents,logging": [[*TRAIN, "--tensorboard", "--wandb"]],
    "agents,cluster": [["-c", SWEEP_ON_A_CLUSTER]],
    "docs": [[*PDOC, "trap_tube_jax", "agents", "agents.curiosity", "agents.networks"]],
    "bench": [["-c", COMPARE_PEERS]],
    "interop": [["-m", "agents.examples.rejax_agent"], ["-m", "agents.examples.sb3_agent"]],
}


def main(extra: str, folder: pathlib.Path) -> None:
    """Runs the uses of an extra."""
    environment = os.environ | {"WANDB_MODE": "offline"}
    if extra not in WHEEL_ALONE:
        environment["PYTHONPATH"] = str(pathlib.Path.cwd())
    folder.mkdir(parents=True)
    for arguments in USES[extra]:
        subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=True)


if __name__ == "__main__":
    main(sys.argv[1], pathlib.Path(sys.argv[2]))
