"""What all benchmarks share: the machine's description, timing, and their records.

A record is a JSON file:

    schema      the name of this layout
    benchmark   which module of `benchmarks` measured
    command     what to type for the same measurement
    machines    the one that it ran on: hardware, versions and commit
    results     what was measured; settings beside it, where the benchmark has more to say
"""

import dataclasses
import pathlib
import shlex
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from agents.experiments.records import check_clean
from agents.runs.folder import write_json
from agents.runs.provenance import provenance as machine
from trap_tube_jax.checks import check_integer

SCHEMA = "trap-tube-jax benchmark 1"
PLACES = ("json", "output")  # options that say nothing of the results


@dataclasses.dataclass(frozen=True)
class Timing:
    """How long a compiled function takes.

    Attributes:
      first_s: seconds of the first call, tracing and compiling included.
      median_s: median seconds of the later calls.
      fastest_s: seconds of the fastest of them.
      slowest_s: seconds of the slowest of them.
    """

    first_s: float
    median_s: float
    fastest_s: float
    slowest_s: float

    @property
    def compile_s(self) -> float:
        """Seconds of tracing and compiling: what the first call took more than the median."""
        return self.first_s - self.median_s


@dataclasses.dataclass(frozen=True)
class Subject:
    """A batch of environments under random actions.

    Attributes:
      name: what the tables call it.
      reset: keys [B] -> (state, timestep).
      step: (state, actions [B, ...]) -> (state, timestep), with auto-reset.
      sample_actions: (key, shape) -> actions [*shape, ...].
      observe: timestep -> observations [B, ...]; the timestep itself if absent.
    """

    name: str
    reset: Callable[[jax.Array], tuple[Any, Any]]
    step: Callable[[Any, jax.Array], tuple[Any, Any]]
    sample_actions: Callable[[jax.Array, tuple[int, ...]], jax.Array]
    observe: Callable[[Any], jax.Array] = lambda timestep: timestep


@dataclasses.dataclass(frozen=True)
class Throughput:
    """The speed of a subject.

    Attributes:
      name: the subject's.
      num_envs: B, environments in the batch, over all devices.
      num_steps: steps of each environment per call.
      devices: how many the batch is divided over.
      steps_per_s: environment steps per second, all together, by the median call.
      observation_bytes: bytes of one environment's observation.
      timing: of one call.
    """

    name: str
    num_envs: int
    num_steps: int
    devices: int
    steps_per_s: float
    observation_bytes: int
    timing: Timing

    @property
    def bytes_per_s(self) -> float:
        """Bytes of observation written per second."""
        return self.steps_per_s * self.observation_bytes


def measure(function: Callable[[], Any], repeats: int = 5) -> Timing:
    """Times a function that returns arrays, from call to completion."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    first, *later = seconds
    return Timing(first, statistics.median(later), min(later), max(later))


def check_counts(
    num_envs: Sequence[int], *, num_steps: int = 1, repeats: int = 1, devices: int = 1
) -> None:
    """Refuses what cannot be measured, before anything is.

    Raises:
      ValueError: naming what must be at least 1, or environments that the devices do not divide.
    """
    check_integer("num_steps", num_steps)
    check_integer("repeats", repeats)
    check_multiples("num_envs", num_envs, "devices", devices)


def check_multiples(name: str, values: Sequence[int], divisor_name: str, divisor: int) -> None:
    """Refuses values that are no positive multiples of the divisor.

    Raises:
      ValueError: naming the value and the divisor.
    """
    check_integer(divisor_name, divisor)
    for value in values:
        if check_integer(name, value) % divisor:
            raise ValueError(f"{name} must be multiples of {divisor_name}={divisor}, got {value}")


def use_devices(number: int) -> None:
    """Makes a CPU appear as this many devices; before JAX is used for the first time.

    Raises:
      ValueError: the accelerators that JAX uses instead are fewer.
    """
    if number > 1:
        jax.config.update("jax_num_cpu_devices", number)
    if number > jax.device_count():
        raise ValueError(
            f"devices must be at most {jax.device_count()}, as many as there are, got {number}; "
            "JAX_PLATFORMS=cpu divides the CPU instead"
        )


def measure_throughput(
    subject: Subject, num_envs: int, *, num_steps: int = 100, repeats: int = 5, devices: int = 1
) -> Throughput:
    """Steps a subject by random actions and consumes every byte of every observation.

    At each step the observations are XORed, byte for byte, into a running array of their
    own size, which the scan carries and so writes to memory each time. The actions are
    drawn before the clock starts. A call goes on where the one before it stopped. Several
    devices step a part of the environments each, and exchange nothing.

    Raises:
      ValueError: see `check_counts`.
    """
    check_counts((num_envs,), num_steps=num_steps, repeats=repeats, devices=devices)
    own_envs = num_envs // devices

    def reset(keys):
        state, timestep = subject.reset(keys)
        observation = subject.observe(timestep)
        return state, jnp.zeros_like(_bits(observation)), observation

    def run(carry, actions):
        def step(carry, actions):
            state, folded = carry
            state, timestep = subject.step(state, actions)
            return (state, folded ^ _bits(subject.observe(timestep))), None

        return jax.lax.scan(step, carry, actions)[0]

    keys = jax.random.split(jax.random.key(0), num_envs).reshape(devices, own_envs)
    actions = subject.sample_actions(jax.random.key(1), (devices, num_steps, own_envs))
    *carry, observation = on_devices(reset, devices)(keys)
    compiled, carry = on_devices(run, devices), tuple(carry)

    def call() -> jax.Array:
        nonlocal carry
        carry = compiled(carry, actions)
        return carry[1]

    timing = measure(call, repeats)
    return Throughput(
        name=subject.name,
        num_envs=num_envs,
        num_steps=num_steps,
        devices=devices,
        steps_per_s=num_envs * num_steps / timing.median_s,
        observation_bytes=observation.nbytes // num_envs,
        timing=timing,
    )


def on_devices(function: Callable[..., Any], devices: int) -> Callable[..., Any]:
    """Compiles a function that runs on every device by itself.

    Arguments and results have the devices as an additional first axis.
    """

    def own(*arrays: Any) -> Any:
        result = function(*jax.tree.map(lambda x: x[0], arrays))
        return jax.tree.map(lambda x: x[None], result)

    if devices == 1:
        return jax.jit(own)
    mesh = jax.make_mesh((devices,), ("devices",), axis_types=(jax.sharding.AxisType.Auto,))
    part = jax.sharding.PartitionSpec("devices")
    mapped = jax.shard_map(own, mesh=mesh, in_specs=part, out_specs=part, check_vma=False)
    return jax.jit(mapped)


def copy_bandwidth(num_bytes: int = 2**28, passes: int = 8) -> float:
    """Bytes per second that a loop over a large array writes, reading as many.

    The array stays in place within a call, so that fresh pages from the operating system
    are a small part of it.
    """
    source = jnp.zeros(num_bytes // 4, jnp.uint32)

    @jax.jit
    def rewrite(array):
        return jax.lax.fori_loop(0, passes, lambda i, old: old ^ i.astype(jnp.uint32), array)

    return passes * num_bytes / measure(lambda: rewrite(source)).median_s


def check_recordable(path: pathlib.Path | None) -> None:
    """Refuses to record what uncommitted code measures; call it before measuring.

    Raises:
      ValueError: there is a path to record to, and git tells of changes or of no commit.
    """
    if path is not None:
        check_clean({"machines": []})


def write_record(
    path: pathlib.Path, benchmark: str, options: Any, results: Sequence[Any], **extra: Any
) -> None:
    """Writes the record of a benchmark.

    Args:
      path: the file.
      benchmark: its module in `benchmarks`.
      options: those that it was run with, a dataclass.
      results: dataclasses.
      extra: what else the record says.

    Raises:
      ValueError: see `check_recordable`.
    """
    check_recordable(path)
    record = {
        "schema": SCHEMA,
        "benchmark": benchmark,
        "command": command(benchmark, options),
        "machines": [machine()],
        **extra,
        "results": [dataclasses.asdict(result) for result in results],
    }
    write_json(path, record)


def command(benchmark: str, options: Any) -> str:
    """What to type for the same measurement: the options that are not the usual ones."""
    parts = ["python", "-m", f"benchmarks.{benchmark}"]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in PLACES or value == field.default:
            continue
        parts.append(f"--{field.name.replace('_', '-')}")
        if value is not True:
            parts += map(str, value if isinstance(value, tuple) else (value,))
    return shlex.join(parts)


def _bits(observation: jax.Array) -> jax.Array:
    """The observations [B, ...] as unsigned integers [B, K] of the same width."""
    flat = observation.reshape(len(observation), -1)
    if flat.dtype == jnp.bool_:
        return flat.astype(jnp.uint8)
    unsigned = jnp.dtype(f"uint{8 * flat.dtype.itemsize}")
    return jax.lax.bitcast_convert_type(flat, unsigned)
