"""Environment steps per second: `python -m benchmarks.env_throughput`.

Environments take random actions and reset automatically, each time with a new task. Every step
folds every byte of the observations into an array of their size, so that all of them are made.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from rich.table import Table

import trap_tube_jax as tt
from benchmarks import harness
from trap_tube_jax.checks import check_integer
from trap_tube_jax.objects import NUM_DIRECTIONS


@dataclasses.dataclass(frozen=True)
class StepOptions(harness.Options):
    """Measures steps per second of the task sets, and of other environments where compared.

    Attributes:
      sets: task sets, by id or short name.
      num_envs: batch sizes, each a multiple of `devices`.
      num_steps: steps of each environment in a timed call; episodes last up to 50.
      devices: number of devices that share the environments; a CPU is split into so many.
    """

    sets: tuple[str, ...] = ("pstsy", "base")
    num_envs: tuple[int, ...] = (4096,)
    num_steps: int = 100
    devices: int = 1

    def check(self) -> None:
        """Checks the options and sets the number of devices; see `harness.Options.check`."""
        check_integer("num_steps", self.num_steps)
        check_integer("devices", self.devices)
        for num_envs in self.num_envs:
            if check_integer("num_envs", num_envs) % self.devices:
                raise ValueError(
                    f"num_envs must be multiples of devices={self.devices}, got {num_envs}"
                )
        for name in self.sets:
            tt.task_set(name)
        use_devices(self.devices)
        super().check()


@dataclasses.dataclass(frozen=True)
class Options(StepOptions):
    """Measures environment steps per second under random actions.

    Attributes:
      plain: measures `jax.vmap` of an `AutoReset` instead of a `VectorEnvironment`.
    """

    plain: bool = False


@dataclasses.dataclass(frozen=True)
class Subject:
    """A batch of environments under random actions.

    Attributes:
      name: name in tables.
      reset: keys [B] -> (state, timestep).
      step: (state, actions [B, ...]) -> (state, timestep); resets automatically after an episode's
        end.
      sample_actions: (key, shape) -> actions [*shape, ...].
      observe: timestep -> observations [B, ...]; by default the timestep itself.
    """

    name: str
    reset: Callable[[jax.Array], tuple[Any, Any]]
    step: Callable[[Any, jax.Array], tuple[Any, Any]]
    sample_actions: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    observe: Callable[[Any], jax.Array] = lambda timestep: timestep


@dataclasses.dataclass(frozen=True)
class Throughput:
    """Speed of a subject.

    Attributes:
      name: name of the subject.
      num_envs: B, environments on all devices together.
      num_steps: steps of each environment in a call.
      devices: number of devices.
      steps_per_s: steps per second of all environments together, by the median call.
      observation_bytes: size of one environment's observation.
      timing: seconds of a call.
    """

    name: str
    num_envs: int
    num_steps: int
    devices: int
    steps_per_s: float
    observation_bytes: int
    timing: harness.Timing

    @property
    def bytes_per_s(self) -> float:
        """Bytes of observations per second."""
        return self.steps_per_s * self.observation_bytes


def bits(observations: jax.Array) -> jax.Array:
    """Returns observations [B, ...] as unsigned integers [B, K] of the same width."""
    rows = observations.reshape(len(observations), -1)
    if rows.dtype == jnp.bool_:
        return rows.astype(jnp.uint8)
    return jax.lax.bitcast_convert_type(rows, jnp.dtype(f"uint{8 * rows.dtype.itemsize}"))


def task_set_subject(task_set: str, *, plain: bool = False) -> Subject:
    """Returns a task set as a `VectorEnvironment` or, if `plain`, by `jax.vmap`."""
    env = tt.make(task_set)
    if plain:
        auto_reset = tt.AutoReset(env)
        reset = jax.vmap(auto_reset.reset)
        step = jax.vmap(auto_reset.step)
    else:
        vector = tt.VectorEnvironment(env)
        reset = vector.reset
        step = vector.step
    return Subject(task_set, reset, step, sample_actions, lambda timestep: timestep.observation)


def sample_actions(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws uniform actions i32[*shape, 2] = (grasp, move)."""
    return jax.random.randint(key, (*shape, 2), 0, NUM_DIRECTIONS)


def measure_throughput(subject: Subject, num_envs: int, options: StepOptions) -> Throughput:
    """Steps a subject by random actions, which are drawn before the clock starts.

    Each call continues from the states of the one before. Devices step their shares of the
    environments and exchange nothing.
    """
    devices = options.devices

    def reset(keys: jax.Array) -> Any:
        state, timestep = subject.reset(keys)
        observations = subject.observe(timestep)
        return (state, jnp.zeros_like(bits(observations))), observations

    def run(carry: Any, actions: jax.Array) -> Any:
        def step(carry: Any, actions: jax.Array) -> tuple[Any, None]:
            state, folded = carry
            state, timestep = subject.step(state, actions)
            return (state, folded ^ bits(subject.observe(timestep))), None

        return jax.lax.scan(step, carry, actions)[0]

    own_envs = num_envs // devices
    keys = jax.random.split(jax.random.key(0), num_envs).reshape(devices, own_envs)
    actions = subject.sample_actions(jax.random.key(1), (devices, options.num_steps, own_envs))
    carry, observations = jax.jit(on_devices(reset, devices))(keys)
    program, compile_s = harness.compiled(on_devices(run, devices), carry, actions)

    calls = []
    for _ in range(options.repeats + 1):
        carry, spent = harness.timed(program, carry, actions)
        calls.append(spent)
    timing = harness.Timing.of(compile_s, calls[1:])
    return Throughput(
        name=subject.name,
        num_envs=num_envs,
        num_steps=options.num_steps,
        devices=devices,
        steps_per_s=num_envs * options.num_steps / timing.median_s,
        observation_bytes=observations.nbytes // num_envs,
        timing=timing,
    )


def on_devices(function: Callable[..., Any], devices: int) -> Callable[..., Any]:
    """Returns a function that runs independently on every device.

    Arguments and results have an additional first axis for the devices.
    """

    def on_one(*arrays: Any) -> Any:
        result = function(*jax.tree.map(lambda x: x[0], arrays))
        return jax.tree.map(lambda x: x[None], result)

    if devices == 1:
        return on_one
    mesh = jax.make_mesh((devices,), ("devices",), axis_types=(jax.sharding.AxisType.Auto,))
    part = jax.sharding.PartitionSpec("devices")
    return jax.shard_map(on_one, mesh=mesh, in_specs=part, out_specs=part, check_vma=False)


def use_devices(number: int) -> None:
    """Splits a CPU into this many devices; call it before the first use of JAX.

    Raises:
      ValueError: JAX uses fewer accelerators.
    """
    if number > 1:
        jax.config.update("jax_num_cpu_devices", number)
    if number > jax.device_count():
        raise ValueError(
            f"devices must be at most {jax.device_count()}, the number of accelerators, got "
            f"{number}; JAX_PLATFORMS=cpu splits the CPU instead"
        )


def main(options: Options) -> list[Throughput]:
    """Measures, prints a table and writes the record."""
    console = harness.begin(options)
    subjects = [task_set_subject(name, plain=options.plain) for name in options.sets]
    results = [
        measure_throughput(subject, num_envs, options)
        for subject in subjects
        for num_envs in options.num_envs
    ]
    table = Table("set", "environments", "M steps/s", "compile, s")
    for result in results:
        table.add_row(
            result.name,
            f"{result.num_envs:,}",
            f"{result.steps_per_s / 1e6:.3f}",
            f"{result.timing.compile_s:.1f}",
        )
    console.print(table)
    harness.write_record("env_throughput", options, results)
    return results


if __name__ == "__main__":
    harness.run(main, Options, "env_throughput")
