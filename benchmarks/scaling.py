"""Throughput and memory over batch size and seeds: `python -m benchmarks.scaling`.

Every point is measured in a process of its own, so that its peak memory is its own too.
"""

import dataclasses
import json
import pathlib
import resource
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from agents import Config, make_train
from agents.experiments import figures
from agents.experiments.records import Record
from benchmarks import harness
from benchmarks.env_throughput import subject
from trap_tube_jax.checks import check_integer
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.registry import task_set

Kind = Literal["environment", "episodes", "seeds"]
TITLES: dict[Kind, str] = {
    "environment": "environment: steps/s over environments",
    "episodes": "training: transitions/s over episodes per iteration",
    "seeds": "training: transitions/s over seeds, all seeds together",
}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """What to measure.

    Attributes:
      sets: task sets of the environment's points, by id or short name.
      num_envs: batch sizes of the environment.
      episodes: episodes per iteration of training, on base; whole minibatches of the fast preset.
      seeds: seeds trained side by side, 256 episodes each, on base.
      json: file to write the record to; refused unless all is of committed code.
    """

    sets: tuple[str, ...] = ("base", "pstsy")
    num_envs: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096, 16384, 65536)
    episodes: tuple[int, ...] = (64, 256, 1024, 4096)
    seeds: tuple[int, ...] = (1, 2, 4, 8)
    json: pathlib.Path | None = None


@dataclasses.dataclass(frozen=True)
class Point:
    """One measurement.

    Attributes:
      kind: what varies: environments, episodes per iteration, or seeds.
      env: short name of the task set.
      size: how many of them.
      steps_per_s: environment steps per second, all together; in training with one epoch
        of learning from each.
      peak_bytes: the largest resident memory of the process, JAX itself included.
      compile_s: seconds of tracing and compiling; see `harness.Timing`.
    """

    kind: Kind
    env: str
    size: int
    steps_per_s: float
    peak_bytes: int
    compile_s: float


def measure(kind: Kind, env: str, size: int) -> Point:
    """One point, in this process."""
    if kind == "environment":
        result = harness.measure_throughput(subject(env), size, repeats=3)
        steps_per_s, timing = result.steps_per_s, result.timing
    else:
        steps_per_s, timing = _measure_training(kind, env, size)
    return Point(kind, env, size, steps_per_s, peak_bytes(), timing.compile_s)


def peak_bytes() -> int:
    """The largest resident memory that this process has had."""
    unit = 1 if sys.platform == "darwin" else 1024  # bytes on macOS, elsewhere KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _measure_training(kind: Kind, env: str, size: int) -> tuple[float, harness.Timing]:
    episodes, seeds = (size, 1) if kind == "episodes" else (256, size)
    config = Config.preset("fast", env_id=env, episodes=episodes, epochs=1)
    train = make_train(config)
    keys = jax.vmap(jax.random.key)(jax.numpy.arange(seeds))
    if seeds == 1:
        state, iterate = jax.jit(train.init)(keys[0]), jax.jit(train.iterate)
    else:
        state, iterate = jax.jit(jax.vmap(train.init))(keys), jax.jit(jax.vmap(train.iterate))
    timing = harness.measure(lambda: iterate(state), repeats=3)
    after, _ = iterate(state)
    return float(after.transitions.sum()) / timing.median_s, timing


def _measure_apart(kind: Kind, env: str, size: int) -> Point:
    """One point, in a fresh process.

    Raises:
      ChildProcessError: the process failed; it has said why.
    """
    command = [sys.executable, "-m", "benchmarks.scaling", "point", kind, env, str(size)]
    try:
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    except subprocess.CalledProcessError as error:
        raise ChildProcessError(f"{kind} {size:,} on {env}: {error}") from error
    return Point(**json.loads(done.stdout.splitlines()[-1]))


def drawings(record: Record, name: str) -> dict[str, Callable[[pathlib.Path], None]]:
    """What draws the figure of a record, by the name of its file."""
    return {f"{name}.png": partial(save_figure, record)}


def digest(record: Record) -> str:
    """That of a record's figure: what it is drawn from."""
    return figures.digest_of(record, save_figure)


def save_figure(record: Record, path: pathlib.Path) -> None:
    """Throughput and memory, one column per kind."""
    points = [Point(**result) for result in record["results"]]
    kinds: list[Kind] = [kind for kind in TITLES if any(point.kind == kind for point in points)]
    figure = Figure(figsize=(4.5 * len(kinds), 6), layout="constrained")
    axes: Any = figure.subplots(2, len(kinds), squeeze=False, sharex="col")
    for column, kind in enumerate(kinds):
        top, bottom = axes[:, column]
        sizes = sorted({point.size for point in points if point.kind == kind})
        for env in dict.fromkeys(point.env for point in points if point.kind == kind):
            chosen = [point for point in points if (point.kind, point.env) == (kind, env)]
            at = [point.size for point in chosen]
            top.plot(at, [point.steps_per_s for point in chosen], "o-", label=env)
            bottom.plot(at, [point.peak_bytes / 2**30 for point in chosen], "o-", label=env)
        quantity, _, over = TITLES[kind].partition(" over ")
        top.set(title=quantity)
        bottom.set(xlabel=over.partition(",")[0], xscale="log")
        bottom.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=45, ha="right")
        bottom.minorticks_off()
        for axis in (top, bottom):
            axis.set_ylim(bottom=0)
            axis.grid(alpha=0.3)
            axis.legend()
    axes[0, 0].set_ylabel("per second")
    axes[1, 0].set_ylabel("peak memory of the process, GiB")
    figures.write(figure, path, digest(record))


def main(arguments: Arguments) -> list[Point]:
    """Measures all points, prints tables, and writes what is asked for."""
    # What cannot be measured is refused at once, not after what can.
    sets = [task_set(name).short for name in arguments.sets]
    harness.check_counts(arguments.num_envs)
    for seeds in arguments.seeds:
        check_integer("seeds", seeds)
    minibatch = Config.preset("fast").minibatch_size
    harness.check_multiples("episodes", arguments.episodes, "minibatch", minibatch)
    harness.check_recordable(arguments.json)
    console = Console()
    console.print(harness.machine())
    wanted: list[tuple[Kind, str, int]] = [
        *(("environment", env, size) for env in sets for size in arguments.num_envs),
        *(("episodes", "base", size) for size in arguments.episodes),
        *(("seeds", "base", size) for size in arguments.seeds),
    ]
    points = [_measure_apart(*point) for point in track(wanted, "Measuring", console=console)]
    for kind, title in TITLES.items():
        table = Table("set", kind, "per second", "peak memory, GiB", "compile, s", title=title)
        for point in points:
            if point.kind == kind:
                table.add_row(
                    point.env,
                    f"{point.size:,}",
                    f"{point.steps_per_s:,.0f}",
                    f"{point.peak_bytes / 2**30:.2f}",
                    f"{point.compile_s:.1f}",
                )
        console.print(table)
    if arguments.json is not None:
        harness.write_record(arguments.json, "scaling", arguments, points)
    return points


if __name__ == "__main__":
    with plain_errors():
        if sys.argv[1:2] == ["point"]:
            _kind, _env, _size = sys.argv[2:]
            print(json.dumps(dataclasses.asdict(measure(_kind, _env, int(_size)))))  # type: ignore[arg-type]
        else:
            main(tyro.cli(Arguments, description=__doc__))
