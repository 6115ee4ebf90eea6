"""Scores by the benchmark's protocol.

    tasks.py         the fixed tasks of a set
    scores.py        records of scores, their intervals and tables
    suite.py         tasks of several sets, for programs that play many at once
    python_agent.py  agents in plain Python
    benchmark.py     any policy or agent scored in one call

Source: protocol.md.
"""

from trap_tube_jax.scoring.benchmark import Policy, score, score_gymnasium
from trap_tube_jax.scoring.scores import Layouts, Optimality, Score, Scores, wilson_interval
from trap_tube_jax.scoring.suite import Outcome, Suite
from trap_tube_jax.scoring.tasks import ALL_SETS, PROTOCOL, Purpose, evaluation_tasks, fixed_tasks

__all__ = [
    "ALL_SETS",
    "PROTOCOL",
    "Layouts",
    "Optimality",
    "Outcome",
    "Policy",
    "Purpose",
    "Score",
    "Scores",
    "Suite",
    "evaluation_tasks",
    "fixed_tasks",
    "score",
    "score_gymnasium",
    "wilson_interval",
]
