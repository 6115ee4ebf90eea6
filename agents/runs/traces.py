"""Traced programs, kept from one process to the next beside the compiled ones.

JAX looks up a compiled program by what the traced one says, so that every process has to trace it
first, which takes longer than all else until training begins. Here the trace is kept, too, and
taken up only where tracing anew would give the same.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import pickle
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
from jax import export

import agents
import trap_tube_jax
from agents.config import Config
from agents.runs.machine import VERSIONED

# Files changed later than this may not be what was imported. Imports take some seconds at most.
UNCHANGED_SINCE = time.time() - 30


class Traces(NamedTuple):
    """A folder of traced programs.

    Attributes:
      folder: one file per program, which a program of newer code replaces.
      code: what has to be the same for a trace to be taken up: sources, versions, JAX's settings.
    """

    folder: Path
    code: bytes

    @classmethod
    def of(cls, config: Config) -> Self | None:
        """Those of this process, beside JAX's cache; None where traces must not be kept.

        They are kept where nothing but this package's sources decides what is traced: by its own
        commands, without imported modules, on a CPU, in a single process; and not where JAX's
        cache is off.
        """
        command = getattr(sys.modules["__main__"], "__spec__", None)
        settings = jax.config.values
        folder = settings["jax_compilation_cache_dir"]
        is_kept = (
            command is not None
            and command.name.startswith(f"{agents.__name__}.")
            and not config.imports
            and jax.default_backend() == "cpu"
            and jax.process_count() == 1
            and settings["jax_enable_compilation_cache"]
            and folder
        )
        code = code_digest() if is_kept else None
        return None if code is None else cls(Path(folder) / "traces", code)

    def kept(
        self, make: Callable[[], Callable[..., Any]], arguments: tuple, *about: Any
    ) -> Callable[..., Any]:
        """The function that `make` returns, as it was traced by this or an earlier process.

        Args:
          make: makes the function; called where there is no trace of it.
          arguments: those to trace with, or their shapes; the only ones it can be called with.
          *about: all that the function depends on beside the code, of values with a telling repr.
        """
        leaves, structure = jax.tree.flatten(arguments)
        shapes = [(x.shape, str(x.dtype)) for x in leaves]
        name = hashlib.sha256(repr((about, str(structure), shapes)).encode()).hexdigest()
        path = self.folder / name
        found = self._read(path)
        if found is None:
            found = _trace(make(), leaves, structure)
            self._write(path, *found)
        exported, outputs = found

        def call(*arguments: Any) -> Any:
            return jax.tree.unflatten(outputs, exported.call(*jax.tree.leaves(arguments)))

        return call

    def _read(self, path: Path) -> tuple[export.Exported, Any] | None:
        """A trace and the structure of its outputs; None if there is none of this code."""
        try:
            content = path.read_bytes()
        except OSError:
            return None
        head, body = content[: 2 * len(self.code)], content[2 * len(self.code) :]
        if head != self.code + hashlib.sha256(body).digest():
            return None
        # Whoever can write here could also replace the compiled programs, which lie beside.
        program, outputs = pickle.loads(body)
        return export.deserialize(program), outputs

    def _write(self, path: Path, exported: export.Exported, outputs: Any) -> None:
        body = pickle.dumps((exported.serialize(), outputs))
        with contextlib.suppress(OSError):  # a full or read-only disk costs time alone
            self.folder.mkdir(parents=True, exist_ok=True)
            partial = path.with_name(f"{path.name}.{os.getpid()}")
            partial.write_bytes(self.code + hashlib.sha256(body).digest() + body)
            partial.replace(path)


def _trace(
    function: Callable[..., Any], leaves: list[Any], structure: Any
) -> tuple[export.Exported, Any]:
    outputs: Any = None

    def flat(*leaves: Any) -> list[Any]:
        nonlocal outputs
        found, outputs = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        return found

    return export.export(jax.jit(flat))(*leaves), outputs


def code_digest() -> bytes | None:
    """A digest of the code; None where sources may have changed since they were imported."""
    digest = hashlib.sha256()
    for package in (agents, trap_tube_jax):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            if path.stat().st_mtime > UNCHANGED_SINCE:
                return None
            source = path.read_bytes()
            digest.update(f"{path.relative_to(root)} {len(source)} ".encode() + source)
    versions = [sys.version, *map(importlib.metadata.version, (*VERSIONED, "chex"))]
    digest.update(repr((versions, sorted(jax.config.values.items()))).encode())
    return digest.digest()
