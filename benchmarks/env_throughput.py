"""Environment steps per second for the eight task sets: `python -m benchmarks.env_throughput`.

Random actions, auto-reset with fresh transfers, every observation consumed; see
`benchmarks.harness.measure_throughput` for how.
"""

import dataclasses
import pathlib

import jax
import tyro
from rich.console import Console
from rich.table import Table

import trap_tube_jax as tt
from benchmarks import harness
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.objects import NUM_DIRECTIONS
from trap_tube_jax.vector import VectorEnvironment

REFERENCE_STEPS_PER_S = 2_400  # the paper's reference environment, one process


@dataclasses.dataclass(frozen=True)
class Arguments:
    """What to measure.

    Attributes:
      sets: ids or short names of task sets.
      num_envs: batch sizes, each a multiple of `devices`.
      num_steps: steps of each environment per timed call; episodes last up to 50.
      repeats: timed calls; the median counts.
      devices: devices to divide the environments over; a CPU is made to appear as so many.
      plain: measure `jax.vmap` of an `AutoReset`, the fast path's reference, instead.
      json: file to write the record to; refused unless all is of committed code.
    """

    sets: tuple[str, ...] = tuple(task_set.short for task_set in tt.PAPER_TASK_SETS)
    num_envs: tuple[int, ...] = (16, 256, 1024, 4096, 16384)
    num_steps: int = 100
    repeats: int = 20
    devices: int = 1
    plain: bool = False
    json: pathlib.Path | None = None


def subject(task_set: str, *, plain: bool = False) -> harness.Subject:
    """A task set under the fast path, or under its plain reference."""
    env = tt.make(task_set)
    if plain:
        auto_reset = tt.AutoReset(env)
        reset, step = jax.vmap(auto_reset.reset), jax.vmap(auto_reset.step)
    else:
        vector = VectorEnvironment(env)
        reset, step = vector.reset, vector.step
    return harness.Subject(task_set, reset, step, sample_actions, lambda each: each.observation)


def sample_actions(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Uniform actions i32[*shape, 2] = (grasp, move)."""
    return jax.random.randint(key, (*shape, 2), 0, NUM_DIRECTIONS)


def main(arguments: Arguments) -> list[harness.Throughput]:
    """Measures, prints a table, and writes JSON if asked to."""
    harness.check_counts(
        arguments.num_envs,
        num_steps=arguments.num_steps,
        repeats=arguments.repeats,
        devices=arguments.devices,
    )
    harness.use_devices(arguments.devices)
    harness.check_recordable(arguments.json)
    subjects = [subject(name, plain=arguments.plain) for name in arguments.sets]
    console = Console()
    console.print(harness.machine())
    bandwidth = harness.copy_bandwidth()
    console.print(f"copy: {bandwidth / 1e9:.1f} GB/s written")
    table = Table("set", "environments", "M steps/s", "x reference", "of copy", "compile, s")
    results = []
    for measured in subjects:
        for num_envs in arguments.num_envs:
            result = harness.measure_throughput(
                measured,
                num_envs,
                num_steps=arguments.num_steps,
                repeats=arguments.repeats,
                devices=arguments.devices,
            )
            results.append(result)
            table.add_row(
                measured.name,
                f"{num_envs:,}",
                f"{result.steps_per_s / 1e6:.3f}",
                f"{result.steps_per_s / REFERENCE_STEPS_PER_S:,.0f}",
                f"{result.bytes_per_s / bandwidth:.0%}",
                f"{result.timing.compile_s:.1f}",
            )
    console.print(table)
    if arguments.json is not None:
        extra = {"plain": arguments.plain, "copy_bytes_per_s": bandwidth}
        harness.write_record(arguments.json, "env_throughput", arguments, results, **extra)
    return results


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Arguments, description=__doc__))
