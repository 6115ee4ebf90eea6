"""Greedy play of given tasks."""

from typing import NamedTuple

import jax

import trap_tube_jax as tt
from agents.acting.encoding import Encoding
from agents.acting.rollout import rollout
from agents.acting.symmetry import Symmetry
from agents.networks.agent import Agent, Params


class Evaluation(NamedTuple):
    """B episodes of greedy play.

    Attributes:
      solved: bool[B].
      length: i32[B], steps taken.
      action: i32[B, T, 2], (grasp, move); meaningless from `length` on.
      value: f32[B, T], the value of every state, by the extrinsic value head where rewards have
        separate ones; meaningless from `length` on.
    """

    solved: jax.Array
    length: jax.Array
    action: jax.Array
    value: jax.Array


def evaluate(
    agent: Agent,
    params: Params,
    env: tt.Environment,
    tasks: tt.State,
    encoding: Encoding | None = None,
) -> Evaluation:
    """Plays each of B tasks at time 0 once, with the most probable actions. Pure; jit it.

    `env` gives the dynamics and the step limit; its transfers are not used. `encoding` encodes
    observations, by default one by one.
    """
    played = rollout(agent, params, env, tasks, None, encoding)
    action = jax.vmap(Symmetry.original_action)(played.symmetry, played.episodes.action)
    value = played.value[:, :-1, 0]
    return Evaluation(played.episodes.solved, played.episodes.length, action, value)
