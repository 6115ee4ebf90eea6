"""The trap-tube task of tool use as a functional, vectorised JAX gridworld."""

import contextlib
import importlib

from trap_tube_jax._version import __version__ as __version__
from trap_tube_jax.environment import (
    ArraySpec,
    Environment,
    action_from_index,
    action_to_index,
)
from trap_tube_jax.graded import graded_perceptual, graded_structural
from trap_tube_jax.objects import base_palette
from trap_tube_jax.observation import observe, render_ascii, visible_objects
from trap_tube_jax.registry import (
    CONTROL_TASK_SETS,
    PAPER_TASK_SETS,
    TaskSet,
    make,
    register,
    registered_ids,
    task_set,
)
from trap_tube_jax.rendering import render, save_gif
from trap_tube_jax.scoring.benchmark import score, score_gymnasium
from trap_tube_jax.scoring.scores import Score, Scores
from trap_tube_jax.solver import Distances, Plan, distances, solve, solve_batch
from trap_tube_jax.state import State, TimeStep, base_state, validate
from trap_tube_jax.transfers import Transfer, compose, perceptual, structural, symbolic
from trap_tube_jax.vector import VectorEnvironment, VectorState
from trap_tube_jax.wrappers import AutoReset, EpisodeStatistics

# Gymnasium's convention: importing a package registers its environments. Needs Gymnasium >= 1.1.
with contextlib.suppress(ImportError):
    importlib.import_module("trap_tube_jax.adapters.to_gymnasium")

__all__ = [
    "CONTROL_TASK_SETS",
    "PAPER_TASK_SETS",
    "ArraySpec",
    "AutoReset",
    "Distances",
    "Environment",
    "EpisodeStatistics",
    "Plan",
    "Score",
    "Scores",
    "State",
    "TaskSet",
    "TimeStep",
    "Transfer",
    "VectorEnvironment",
    "VectorState",
    "action_from_index",
    "action_to_index",
    "base_palette",
    "base_state",
    "compose",
    "distances",
    "graded_perceptual",
    "graded_structural",
    "make",
    "observe",
    "perceptual",
    "register",
    "registered_ids",
    "render",
    "render_ascii",
    "save_gif",
    "score",
    "score_gymnasium",
    "solve",
    "solve_batch",
    "structural",
    "symbolic",
    "task_set",
    "validate",
    "visible_objects",
]
