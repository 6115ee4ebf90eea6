"""Speed of seeds trained in one program: `python -m benchmarks.seeds`.

Times `jax.vmap` of an iteration over seeds, as `agents.sweep --seeds-per-program` trains them. Run
the command twice with JAX's persistent compilation cache to see what a second start costs.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
from rich.table import Table

import trap_tube_jax as tt
from agents import Config, TrainState, make_learner
from agents.runs import compilation
from benchmarks import harness
from trap_tube_jax.checks import check_integer


@dataclasses.dataclass(frozen=True)
class Options(harness.Options):
    """Times iterations of one or several seeds in one program.

    Attributes:
      preset: settings of training.
      sets: task sets to train on, by id or short name; by default the preset's.
      seeds: numbers of seeds in one program; 1 trains without `jax.vmap`.
      iterations: iterations per timed call.
      cache: keeps compiled programs for later commands, and uses earlier ones.
    """

    repeats: int = 3
    preset: str = "best"
    sets: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (1, 8)
    iterations: int = 5
    cache: bool = False

    def check(self) -> None:
        """Checks the options before anything is measured."""
        super().check()
        check_integer("iterations", self.iterations)
        for number in self.seeds:
            check_integer("seeds", number)


@dataclasses.dataclass(frozen=True)
class Speed:
    """Speed of seeds in one program.

    Attributes:
      preset: name of the settings.
      env_id: task set.
      path: how observations are encoded, `plain` or `fast`.
      seeds: seeds in the program.
      steps_per_s: environment steps per second of all seeds together.
      seconds: seconds of one iteration of all seeds.
      timing: seconds of a call, which makes several iterations.
    """

    preset: str
    env_id: str
    path: str
    seeds: int
    steps_per_s: float
    seconds: float
    timing: harness.Timing


def measure(config: Config, seeds: int, options: Options) -> Speed:
    """Times calls of several iterations of `seeds` seeds."""
    learner = make_learner(config)
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    init = learner.init
    iterate = learner.iterate
    if seeds > 1:
        init = jax.vmap(init)
        iterate = jax.vmap(iterate)
    else:
        keys = keys[0]

    def train(state: TrainState) -> TrainState:
        return jax.lax.fori_loop(0, options.iterations, lambda _, now: iterate(now)[0], state)

    state = jax.jit(init)(keys)
    program, compile_s = harness.compiled(train, state)
    calls = []
    steps = []
    for _ in range(options.repeats + 1):
        before = int(jnp.sum(state.transitions))
        state, spent = harness.timed(program, state)
        calls.append(spent)
        steps.append(int(jnp.sum(state.transitions)) - before)
    timing = harness.Timing.of(compile_s, calls[1:])
    return Speed(
        options.preset,
        config.env_id,
        learner.encoding.name,
        seeds,
        sum(steps[1:]) / options.repeats / timing.median_s,
        timing.median_s / options.iterations,
        timing,
    )


def main(options: Options) -> list[Speed]:
    """Measures, prints a table and writes the record."""
    if options.cache:
        compilation.enable_cache()
    preset = Config.preset(options.preset)
    names = [tt.task_set(name).id for name in options.sets or (preset.env_id,)]
    configs = [Config.preset(options.preset, env_id=name) for name in names]
    console = harness.begin(options)
    columns = ("set", "path", "seeds", "s/iteration", "steps/s", "compile, s")
    table = Table(*columns, title=f"preset {options.preset}")
    results = []
    for config, seeds in itertools.product(configs, options.seeds):
        speed = measure(config, seeds, options)
        results.append(speed)
        table.add_row(
            tt.task_set(config.env_id).short,
            speed.path,
            str(seeds),
            f"{speed.seconds:.3f}",
            f"{speed.steps_per_s:,.0f}",
            f"{speed.timing.compile_s:.1f}",
        )
    console.print(table)
    harness.write_record("seeds", options, results)
    return results


if __name__ == "__main__":
    harness.run(main, Options, "seeds")
