"""All measurements of an accelerator in one command: `python -m benchmarks.accelerator`.

Runs other benchmarks one after another, each in a process of its own, which it stops after a time
limit. A benchmark that fails or is stopped does not keep the others from running. Every record is
written as soon as it is measured.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from benchmarks import harness
from trap_tube_jax.interruptions import Stopped, deferring

FIRST_START = "gpu_best_first_start"
SECOND_START = "gpu_best_second_start"  # finds the programs that the first has compiled
# The module and its options, by the name of the record.
MEASUREMENTS: dict[str, str] = {
    "gpu_paper": "learner_peers --sets pstsy --networks paper --programs ours plain "
    "--episodes-per-iteration 1024 --minibatch-size 128 --epochs 10",
    "gpu_best": "seeds --preset best --seeds 1 8",
    "gpu_fast": "seeds --preset fast --seeds 1 8",
    FIRST_START: "seeds --preset best --seeds 8 --cache",
    SECOND_START: "seeds --preset best --seeds 8 --cache",
    "gpu_rejax": "learner_peers --sets base --networks dense feedforward",
    "gpu_peers": "peers --num-envs 4096 65536 524288",
}
# The same on the smallest scale, to try the command on a CPU.
SMALL: dict[str, str] = {
    "gpu_paper": "learner_peers --sets pstsy --networks paper --programs ours plain "
    "--episodes-per-iteration 4 --minibatch-size 4 --repeats 1",
    "gpu_fast": "seeds --preset fast --sets base --seeds 1 2 --iterations 1 --repeats 1",
    "gpu_peers": "peers --num-envs 16 --num-steps 8 --sets base",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Runs the benchmarks of a GPU or TPU and writes their records.

    Attributes:
      output: folder for the records; needs committed code. Without it, prints only.
      only: names of the records to measure, by default all.
      limit: seconds after which a benchmark is stopped.
      small: measures almost nothing, to try the command.
    """

    output: Path | None = None
    only: tuple[str, ...] = ()
    limit: int = 500
    small: bool = False


def main(options: Options) -> list[str]:
    """Runs the benchmarks; returns the names of those that failed.

    Raises:
      ValueError: a name is unknown, or a second start is asked for without the first.
    """
    measurements = SMALL if options.small else MEASUREMENTS
    for name in options.only:
        if name not in measurements:
            raise ValueError(f"no measurement {name!r}; allowed: {', '.join(measurements)}")
    names = [name for name in measurements if name in (options.only or measurements)]
    if SECOND_START in names and FIRST_START not in names:
        raise ValueError(f"{SECOND_START} needs {FIRST_START} in --only, too")
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as cache:  # empty, as a first start needs it
        for name in names:
            lacks_first = name == SECOND_START and FIRST_START in failed
            if lacks_first or not run(name, measurements[name].split(), options, cache):
                failed.append(name)
    print(f"failed: {', '.join(failed) or 'none'}")
    return failed


def run(name: str, words: list[str], options: Options, cache: str) -> bool:
    """Runs one benchmark, with a cache folder for compiled programs; returns if it succeeded."""
    command = [sys.executable, "-m", f"benchmarks.{words[0]}", *words[1:]]
    if options.output is not None:
        command += ["--output", str(options.output / f"{name}.json")]
    print(f"== {name}: {' '.join(command[1:])}", flush=True)
    start = time.perf_counter()
    code = call(command, options.limit, {**os.environ, "XDG_CACHE_HOME": cache})
    outcome = "stopped" if code is None else f"exit code {code}"
    print(f"== {name}: {outcome} after {time.perf_counter() - start:.0f} s", flush=True)
    return code == 0


def call(command: list[str], limit: float, environ: Mapping[str, str]) -> int | None:
    """Runs a command; returns its exit code, None if it takes more than `limit` seconds.

    Raises:
      Stopped: on a signal, after the command has ended.
    """
    code = None
    with subprocess.Popen(command, env=environ) as process, deferring(process.terminate) as request:
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            process.kill()
    if number := request():
        raise Stopped(number)
    return code


if __name__ == "__main__":
    harness.run(lambda options: sys.exit(bool(main(options))), Options, "accelerator")
