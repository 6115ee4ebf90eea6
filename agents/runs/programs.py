"""One iteration of all seeds, as three programs that compile at the same time.

Much of a compilation runs on one core: as a single program an iteration takes a quarter longer to
compile on two. Each program compiles while the next one is traced, and the first iteration begins
as soon as the first program is there. Where an earlier process has traced them, they are not traced
again.
"""

import contextlib
import functools
import gc
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from typing import Any

import jax
import jax.numpy as jnp

from agents.acting.evaluation import evaluate
from agents.parallel.sharding import Placement
from agents.ppo.learner import Batch, Learner, Metrics, TrainState
from agents.runs.compilation import compiled, in_background
from trap_tube_jax.scoring.tasks import evaluation_tasks

# States of all seeds [S, ...], their batches between play and learning, and bool[S]; to states,
# batches and metrics [S].
Carry = tuple[TrainState, Batch | None]
Phase = Callable[[TrainState, Batch | None, jax.Array], tuple[Carry, Metrics]]


def collecting(train: Learner) -> Phase:
    """Plays."""

    def collect(state: TrainState, _: None) -> tuple[Carry, Metrics]:
        after, batch, metrics = train.collect(state)
        steps = after.transitions - state.transitions
        return (after, batch), {**metrics, "transitions": after.transitions, "steps": steps}

    return functools.partial(_for_all_seeds, collect)


def learning(train: Learner) -> Phase:
    """Learns from what was played."""

    def learn(state: TrainState, batch: Batch) -> tuple[Carry, Metrics]:
        state, metrics = train.learn(state, batch)
        return (state, None), {**metrics, "episodes": state.episodes}

    return functools.partial(_for_all_seeds, learn)


def judging(train: Learner) -> Phase:
    """Plays the validation tasks greedily."""
    config = train.config
    tasks = evaluation_tasks(config.env_id, config.eval_episodes, config.num_features, "validation")

    def judge(state: TrainState, _: None) -> tuple[Carry, Metrics]:
        outcome = evaluate(train.agent, state.params, train.env, tasks, train.shards)
        return (state, None), {"evaluation": jnp.mean(outcome.solved.astype(jnp.float32))}

    return functools.partial(_for_all_seeds, judge)


# What makes the parts of an iteration, in order. Each part takes the states of all seeds [S, ...],
# their batches (of the phase before; None at first) and bool[S], the seeds to advance; the others
# stay as they are. It returns states and batches for the next part, and metrics [S].
PHASES: tuple[Callable[[Learner], Phase], ...] = (collecting, learning, judging)


def _for_all_seeds(
    phase: Any, states: TrainState, batches: Batch | None, active: jax.Array
) -> tuple[Carry, Metrics]:
    if len(active) > 1:
        (after, batches), metrics = jax.vmap(phase)(states, batches)
        stays = functools.partial(jax.vmap(jnp.where), active)
        return (jax.tree.map(stays, after, states), batches), metrics
    # A vmapped loop has to carry on until the slowest of its elements is done. A run whose only
    # seed is solved is over.
    first = jax.tree.map(lambda x: x[0], (states, batches))
    return jax.tree.map(lambda x: x[None], phase(*first))


class Programs:
    """The phases, compiled in the background; call them for one iteration.

    Attributes:
      pending: one program for each phase, in order, some of them still to come.
      ready_at: when the newest of them came, by `time.perf_counter`.
    """

    def __init__(self, train: Learner, placement: Placement, states: TrainState, active: Any):
        """Begins to compile.

        Args:
          train: the learner.
          placement: the devices.
          states: the states that the first iteration will take, or their shapes.
          active: bool[S].
        """
        self.pending: list[futures.Future[jax.stages.Compiled]] = []
        self.ready_at = time.perf_counter()

        def lower(
            make: Callable[[Learner], Phase], before: futures.Future | None
        ) -> tuple[jax.stages.Lowered, Any]:
            inputs = (states, None, active) if before is None else (*before.result()[1], active)

            with _uncollected():
                phase = placement.shard(make(train))
                jitted = jax.jit(phase, donate_argnums=0, in_shardings=placement.sharding)
                traced = jitted.trace(*inputs)
                return traced.lower(), traced.out_info[0]

        def finish(lowered: futures.Future) -> jax.stages.Compiled:
            program = compiled(lowered.result()[0], train.config)
            self.ready_at = time.perf_counter()
            return program

        lowered = None
        tracer = futures.ThreadPoolExecutor(1)  # one trace after the other
        for make in PHASES:
            lowered = tracer.submit(lower, make, lowered)
            self.pending.append(in_background(finish, lowered))
        tracer.shutdown(wait=False)

    def __call__(self, states: TrainState, active: Any) -> tuple[TrainState, Metrics]:
        """The states after an iteration of the active seeds, and metrics [S]. Takes the states."""
        carry: Carry = (states, None)
        metrics: Metrics = {}
        for program in self.pending:
            carry, more = program.result()(*carry, active)
            metrics |= more
        return carry[0], dict(sorted(metrics.items()))


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Without garbage collection, which takes a fifth of the time of tracing and finds nothing."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
