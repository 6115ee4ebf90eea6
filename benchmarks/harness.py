"""Timing and records that all benchmarks share.

A record is a JSON file:

    schema      name of this layout
    benchmark   module of `benchmarks` that measured
    command     what to type for the same measurement
    machine     hardware, versions, devices and commit
    results     one entry a measurement; some benchmarks add settings next to it
"""

import dataclasses
import functools
import json
import pathlib
import shlex
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, Self

import jax

from agents.command_line import parse
from agents.runs.console import CommandConsole
from agents.runs.provenance import commit, provenance
from trap_tube_jax.checks import check_integer
from trap_tube_jax.command_line import announce, plain_errors
from trap_tube_jax.interruptions import run_command

SCHEMA = "trap-tube-jax benchmark 2"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every benchmark.

    Attributes:
      repeats: number of timed calls; the median counts.
      output: file to write the record to; needs committed code.
    """

    repeats: int = 5
    output: pathlib.Path | None = None

    def check(self) -> None:
        """Checks the options before anything is measured.

        Raises:
          ValueError: an option is not allowed, or `output` is given and the code is uncommitted.
        """
        check_integer("repeats", self.repeats)
        if self.output is not None and self.output.is_dir():
            raise ValueError(f"output must be a file, and {self.output} is a folder")
        name = commit()
        if self.output is not None and (name is None or name.endswith("-dirty")):
            raise ValueError(
                f"a record needs committed code, in a git checkout; the commit is {name}: commit "
                "the changes, or leave out --output"
            )


def begin(options: Options) -> CommandConsole:
    """Checks the options, and prints the machine and how long measuring takes.

    Raises:
      ValueError: see `Options.check`.
    """
    options.check()
    console = CommandConsole()
    console.print(machine())
    announce("Compiling and measuring, up to a minute per row on an idle machine")
    return console


def run(main: Callable[[Any], Any], options: type, benchmark: str) -> None:
    """Runs the command line of a benchmark, a module of `benchmarks`; see `run_command`."""

    @plain_errors()
    def command_line() -> None:
        main(parse(options, None, f"python -m benchmarks.{benchmark}"))

    run_command(command_line)


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds that a compiled function takes.

    Attributes:
      compile_s: tracing and compiling.
      median_s: median of the timed calls, which follow one that is not timed.
      fastest_s: fastest of them.
      slowest_s: slowest of them.
    """

    compile_s: float
    median_s: float
    fastest_s: float
    slowest_s: float

    @classmethod
    def of(cls, compile_s: float, calls: Sequence[float]) -> Self:
        """Summarises the seconds of single calls."""
        return cls(compile_s, statistics.median(calls), min(calls), max(calls))


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """Compiles a function for these arguments; returns it and the seconds that took."""
    start = time.perf_counter()
    # A new function, or JAX would return a program that it has compiled before.
    program = jax.jit(functools.partial(function)).lower(*arguments).compile()
    return program, time.perf_counter() - start


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Calls a function; returns its result, and the seconds until the arrays in it are ready."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


def measure(function: Callable[..., Any], *arguments: Any, repeats: int = 5) -> Timing:
    """Compiles and times a function of arrays, after one call to warm up."""
    program, compile_s = compiled(function, *arguments)
    _, *calls = [timed(program, *arguments)[1] for _ in range(repeats + 1)]
    return Timing.of(compile_s, calls)


def machine() -> dict[str, Any]:
    """Returns hardware, versions, devices and commit."""
    return {**provenance(), "devices": jax.device_count()}


def write_record(benchmark: str, options: Options, results: Sequence[Any], **extra: Any) -> None:
    """Writes the record of a benchmark, if `options.output` asks for one.

    Args:
      benchmark: its module in `benchmarks`.
      options: the options that it ran with.
      results: dataclasses.
      extra: further entries.
    """
    if options.output is None:
        return
    record = {
        "schema": SCHEMA,
        "benchmark": benchmark,
        "command": command(benchmark, options),
        "machine": machine(),
        **extra,
        "results": [dataclasses.asdict(result) for result in results],
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(record, indent=1) + "\n")


def command(benchmark: str, options: Options) -> str:
    """Returns the command line of a measurement: all options that are not the defaults."""
    parts = ["python", "-m", f"benchmarks.{benchmark}"]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name == "output" or value == field.default:
            continue
        parts.append(f"--{field.name.replace('_', '-')}")
        if value is not True:
            parts += map(str, value if isinstance(value, tuple) else (value,))
    return shlex.join(parts)
