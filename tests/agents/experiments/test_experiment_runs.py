"""Whole experiments, as a user runs them: killed, continued, extended."""

import csv
import dataclasses
import io
import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from test_train import TIMING_COLUMNS

import trap_tube_jax as tt
from agents.acting import evaluation
from agents.acting import policy_files as pretrained
from agents.acting.policy import Policy
from agents.arrays import to_arrays
from agents.config import Config
from agents.experiments import __main__ as experiments
from agents.experiments import figures, records, reporting, statistics, tables, training
from agents.experiments.protocol import Protocol
from agents.parallel.sharding import ALONE, Placement
from agents.ppo.learner import make_train
from agents.runs import programs, report, session, stopping, tracking
from agents.runs.checkpoint import Checkpoints, digest
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import MetricsLog
from paths import ROOT
from refusal import refused
from trap_tube_jax.scoring.tasks import ALL_SETS

SMALL = ["filters=[2,2]", "hidden=4", "embedding=2"]
ITERATIONS = 6
# By seed and iteration, the steps taken in the tasks of two sets, 0 where unsolved. The best
# evaluation of seed 0 is its second one, of seed 1 its first.
STEPS = {
    (0, 2): {"base": [0], "p": [2, 0, 0, 0]},
    (0, 4): {"base": [1], "p": [0, 1, 4, 0]},
    (0, 6): {"base": [1], "p": [1, 1, 0, 0]},
    (1, 2): {"base": [0], "p": [3, 3, 0, 0]},
    (1, 4): {"base": [0], "p": [0, 0, 2, 0]},
    (1, 6): {"base": [0], "p": [0, 0, 3, 3]},
}
NOTHING_SOLVED = {"base": [0], "p": [0, 0, 0, 0]}

asked: list[tuple[str, int, str]] = []  # the evaluation tasks: of which set, how many, what for


class Killed(BaseException):
    """Nothing in the way of a process that is killed catches it."""


def fake_train(config, shards=ALONE):
    """Training at once: every parameter becomes 100 * seed + iteration."""
    real = make_train(config, shards=shards)
    shapes = jax.eval_shape(real.init, jax.random.key(0))._replace(key=None)

    def init(key):
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return zeros._replace(key=key)

    def collect(state):
        return (
            state._replace(transitions=state.transitions + 48),
            (),
            {"success": jnp.float32(0.25)},
        )

    def learn(state, batch):
        iteration, seed = state.iteration + 1, jax.random.key_data(state.key)[-1]
        state = state._replace(
            params=jax.tree.map(lambda x: jnp.zeros_like(x) + 100 * seed + iteration, state.params),
            iteration=iteration,
            episodes=state.episodes + 8,
        )
        return state, {}

    return SimpleNamespace(**vars(real), init=init, collect=collect, learn=learn)


class FakeEvaluator:
    def __init__(self, config, tasks):
        self.tasks = tasks

    def __call__(self, params):
        number = int(np.ravel(jax.tree.leaves(params)[0])[0])
        steps = STEPS.get(divmod(number, 100), NOTHING_SOLVED)
        played = {name: jnp.array(steps[name]) for name in self.tasks}
        return {
            name: evaluation.Evaluation(taken > 0, jnp.where(taken > 0, taken, 6), taken, taken)
            for name, taken in played.items()
        }


def fake_evaluate(agent, params, env, tasks, shards):
    nothing = jnp.zeros(len(tasks.time), jnp.int32)
    return evaluation.Evaluation(nothing > 0, nothing, nothing, nothing)


@pytest.fixture(scope="module", autouse=True)
def lab():
    """Experiments in seconds: training, evaluation and solver are fakes, and there are two sets."""
    base = tt.base_state()
    columns = [base.agent.at[1].add(step) for step in range(4)]
    tasks = {
        "base": jax.tree.map(lambda x: x[None], base),
        "p": jax.tree.map(lambda *x: jnp.stack(x), *(base.replace(agent=x) for x in columns)),
    }

    def fake_tasks(name, num_tasks, num_features, purpose="test"):
        short = tt.task_set(name).short
        asked.append((short, num_tasks, purpose))
        return tasks[short]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "make_train", fake_train)
        patch.setattr(programs, "evaluate", fake_evaluate)
        patch.setattr(report, "save_curves", lambda *args: None)
        for module in (tracking, reporting):
            patch.setattr(module, "Evaluator", FakeEvaluator)
        for module in (training, programs):
            patch.setattr(module, "evaluation_tasks", fake_tasks)
        one_step = lambda states: SimpleNamespace(length=np.ones(len(states.time), int))  # noqa: E731
        patch.setattr(reporting, "solve_batch", one_step)
        yield


def run(out, *arguments, seeds=2, iterations=ITERATIONS):
    settings = ["--settings", "max_steps=6", *SMALL, "--tasks", 4, "--evaluate-every", 2]
    counts = ["--seeds", seeds, "--iterations", iterations, "--checkpoint-every", 3]
    given = [
        "exp1",
        "--sets",
        "base",
        "p",
        "--algorithms",
        "ppo",
        *settings,
        *counts,
        "--out",
        out,
    ]
    experiments.main([str(argument) for argument in [*given, "--name", "x", *arguments]])
    return out / "x"


def untimed(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in rows]


def contents(folder):
    """All that a run leaves that must not depend on how often it was stopped."""
    run_folder = RunFolder(folder)
    with Checkpoints(run_folder.checkpoints) as checkpoints:
        arrays, _ = checkpoints.load()
    best = [pretrained.load_policy(path) for path in sorted(folder.glob("best-*.safetensors"))]
    return {
        "metrics": untimed(run_folder.metrics),
        "state": digest(arrays),
        "best": [(policy.iteration, digest(to_arrays(policy.params))) for policy in best],
    }


@pytest.fixture(scope="module")
def whole(lab, tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def record(whole):
    return json.loads((whole / "summary.json").read_text())


def test_evaluations_are_in_the_metrics(whole):
    for seed in (0, 1):
        rows = untimed(whole / f"ppo-seed{seed}" / "metrics.csv")
        assert [row["iteration"] for row in rows] == [str(i + 1) for i in range(ITERATIONS)]
        for row in rows:
            played = STEPS.get((seed, int(row["iteration"])), {"base": [np.nan], "p": [np.nan]})
            shares = [np.mean(np.sign(played[name])) for name in ("base", "p")]
            found = [float(row[f"greedy_{name}"]) for name in ("base", "p", "overall")]
            np.testing.assert_array_equal(found, [*shares, np.mean(shares)])


def test_the_best_parameters_are_kept(whole):
    for seed, iteration in ((0, 4), (1, 2)):
        kept = RunFolder(whole / f"ppo-seed{seed}").kept_best(seed)
        assert max(kept) == iteration
        policy = pretrained.load_policy(kept[iteration])
        assert policy.iteration == iteration
        assert np.all(jax.tree.leaves(policy.params)[0] == 100 * seed + iteration)


def test_the_record_says_how_good_the_best_evaluation_is(whole, record):
    (entry,) = record["algorithms"]
    trial, _ = entry["runs"]
    assert record["schema"] == records.SCHEMA
    assert (trial["iterations"], trial["of"], trial["finished"]) == (6, 6, True)
    assert (trial["episodes"], trial["transitions"]) == (48, 288)
    assert trial["first_solved"] is None
    assert record["machines"][trial["machines"][0]]["jax"] == jax.__version__
    assert (trial["best"]["iteration"], trial["best"]["selected_percent"]) == (4, 75)
    assert trial["best"]["steps"] == STEPS[0, 4]
    scores = statistics.seed_scores(record, trial)
    base, p = scores["base"], scores["p"]
    assert (base.percent, base.interval, str(base.layouts)) == (100, None, "1 of 1")
    assert (p.percent, p.mean_steps, p.layouts) == (50, 2.5, None)
    assert p.optimality is not None
    assert (p.optimality.mean, p.optimality.worst) == ((1 + 1 / 4) / 2, 1 / 4)
    assert {name: about["shortest"] for name, about in record["sets"].items()} == {
        "base": [1],
        "p": [1, 1, 1, 1],
    }
    assert [about["equal_to_base"] for about in record["sets"].values()] == [100, 25]


def test_the_papers_selection_reports_what_it_chose_by(whole, record, tmp_path):
    root = run(tmp_path, "--selection", "paper")
    found = records.read_record(root / "summary.json")
    runs = [entry["runs"] for entry in (record["algorithms"][0], found["algorithms"][0])]
    assert [trial["best"]["steps"] for trial in runs[1]] == [
        trial["best"]["steps"] for trial in runs[0]
    ]
    assert "--selection paper" in found["command"]
    assert "chosen and reported on the same 4 tasks" in (root / "tables.md").read_text()
    assert "on 4 validation tasks a set; reported are 1,000 other tasks" in (
        (whole / "tables.md").read_text()
    )
    tested = json.loads((root / "ppo-seed0" / "tested-seed0.json").read_text())
    assert tested["iteration_and_tasks"] == [4, 4]


@pytest.mark.parametrize(
    ("selection", "chosen_by", "reported"),
    [("validation", (4, "validation"), (7, "test")), ("paper", (4, "test"), (4, "test"))],
)
def test_reported_are_the_test_tasks(selection, chosen_by, reported, tmp_path):
    """Training is stopped by validation tasks, whichever the best evaluation is chosen by."""
    asked.clear()
    run(tmp_path, "--selection", selection, "--reported", 7, seeds=1, iterations=2)
    assert asked == [
        *[(name, *chosen_by) for name in ("base", "p")],
        ("base", 4, "validation"),
        *[(name, *reported) for name in ("base", "p")],
    ]


def test_an_experiment_leaves_tables_and_figures(whole, record, capsys):
    assert figures.drawn_from(whole / "curves.png") == figures.digest(record)
    text = (whole / "tables.md").read_text()
    assert "| PPO + ICM, paper | 5 / 5 | 102,000 ± 60,000 |" in text
    assert tables.markdown(record) in text
    before = (whole / "summary.json").read_bytes()
    where = ["--out", str(whole.parent), "--name", "x"]
    experiments.main(["exp1", *where, "--report-only"])
    assert (whole / "summary.json").read_bytes() == before
    shown = capsys.readouterr().out
    assert str(whole / "curves.png") in shown
    assert "left at most" not in shown


def kill_after(patch, owner, name, is_moment):
    function = getattr(owner, name)

    def wrapped(*args, **kwargs):
        function(*args, **kwargs)
        if is_moment(*args):
            raise Killed

    patch.setattr(owner, name, wrapped)


def test_killed_experiments_continue_to_the_same_bits(whole, tmp_path):
    """Killed in a fourth iteration, one past a checkpoint, after each of its writes.

    The evaluation of the fourth iteration is the best of seed 0, and not of seed 1.
    """

    def appended(seed):
        return lambda log, rows: (rows[0]["seed"], rows[0]["iteration"]) == (seed, 4)

    moments = [
        (pretrained, "save_policy", lambda path, policy: policy.iteration == 4),
        (MetricsLog, "append", appended(seed=0)),
        (MetricsLog, "append", appended(seed=1)),
    ]
    for moment in moments:
        with pytest.MonkeyPatch.context() as patch:
            kill_after(patch, *moment)
            with pytest.raises(Killed):
                run(tmp_path)
    run(tmp_path)
    for name in ("ppo-seed0", "ppo-seed1"):
        assert contents(tmp_path / "x" / name) == contents(whole / name)


def test_more_seeds_and_iterations_add_to_what_is_there(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "x")
    kept = (whole / "ppo-seed0" / "metrics.csv").read_bytes()
    root = run(tmp_path, "--seed", 2, seeds=1)
    assert sorted(path.name for path in root.glob("ppo-*")) == [f"ppo-seed{i}" for i in range(3)]
    assert (root / "ppo-seed0" / "metrics.csv").read_bytes() == kept
    run(tmp_path, seeds=1, iterations=8)
    summary = json.loads((root / "summary.json").read_text())
    assert "--seeds 3 --iterations 8" in summary["command"]
    (entry,) = summary["algorithms"]
    far = [(trial["seed"], trial["iterations"], trial["finished"]) for trial in entry["runs"]]
    assert far == [(0, 8, True), (1, 6, True), (2, 6, True)]
    assert (root / "ppo-seed0" / "metrics.csv").read_bytes().startswith(kept)


def test_seeds_side_by_side_are_those_one_after_another(tmp_path, monkeypatch):
    """Seed 0 solves its set between two evaluations, so it is evaluated then, and no other."""

    def evaluate(agent, params, env, tasks, shards):
        number = jnp.ravel(jax.tree.leaves(params)[0])[0]
        nothing = jnp.zeros(len(tasks.time), jnp.int32)
        is_solved = (number >= 3) & (number < 100)
        return evaluation.Evaluation((nothing == 0) & is_solved, nothing, nothing, nothing)

    monkeypatch.setattr(programs, "evaluate", evaluate)
    apart = run(tmp_path / "apart")
    folder = run(tmp_path / "together", "--side-by-side") / "ppo-seed0to1"
    rows = untimed(folder / "metrics.csv")
    for seed in (0, 1):
        alone = untimed(apart / f"ppo-seed{seed}" / "metrics.csv")
        assert [row for row in rows if row["seed"] == str(seed)] == alone
    evaluated = {(row["seed"], row["iteration"]) for row in rows if row["greedy_p"] != "nan"}
    assert evaluated == {("0", "3"), *((seed, each) for seed in "01" for each in "246")}
    assert [max(RunFolder(folder).kept_best(seed)) for seed in (0, 1)] == [4, 2]


def test_runs_of_algorithms_that_are_not_registered_here_are_refused(capsys, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "x")
    (tmp_path / "x" / "ppo-seed1").rename(tmp_path / "x" / "ppo+mine-seed1")
    arguments = ["exp1", "--out", tmp_path, "--name", "x", "--report-only"]
    assert "unknown algorithm 'ppo+mine'; allowed" in refused(capsys, experiments.main, *arguments)


def test_a_folder_holds_one_experiment(capsys, whole):
    where = ["--out", whole.parent, "--name", "x"]
    assert "holds another experiment than exp2" in refused(capsys, experiments.main, "exp2", *where)
    assert "x has tasks=4, not 5; use another --name" in refused(
        capsys, experiments.main, "exp1", *where, "--tasks", 5
    )


def test_runs_with_a_cooldown_are_not_extended(tmp_path):
    short = Protocol(
        algorithms=("ppo",), seeds=1, settings={"lr_decay_fraction": 0.5}, iterations=4
    )
    training.plan_runs(tmp_path, {"ppo": short.config("ppo")}, short.preset, range(1))
    longer = dataclasses.replace(short, iterations=8)
    with pytest.raises(
        ValueError, match=r"ppo-seed0: the run has lr_decay_fraction=0.5 and iterations=4"
    ):
        training.plan_runs(tmp_path, {"ppo": longer.config("ppo")}, longer.preset, range(1))


def test_the_best_parameters_of_the_last_checkpoint_outlive_a_kill(tmp_path, monkeypatch):
    """The best evaluation is the second; a third, better one comes after the checkpoint."""
    run, folder = Run(Config(curiosity="none")), RunFolder(tmp_path)
    shares = {1: 0.25, 2: 0.5, 3: 0.75, 4: 0.25}
    monkeypatch.setattr(pretrained, "save_policy", lambda path, policy: path.write_text("x"))

    def played(iteration):
        solved: Any = np.arange(4) < 4 * shares[iteration]
        steps: Any = np.ones(4, np.int32)
        return {"p": evaluation.Evaluation(solved, steps, steps, steps)}

    def tracker():
        made: Any = tracking.Tracker(folder, run, {}, ranked=["p"])
        made._evaluator = played
        return made

    def evaluate(made, iteration):
        policy = Policy("x", run.config, iteration, iteration)
        return {"seed": 0, "iteration": iteration, **made.evaluate(0, policy)}

    first = tracker()
    first.resume([], 0)
    rows = [evaluate(first, iteration) for iteration in (1, 2)]
    assert list(folder.kept_best(0)) == [1, 2]
    first.forget(2)
    evaluate(first, 3)
    assert list(folder.kept_best(0)) == [2, 3]  # killed here
    second = tracker()
    second.resume(rows, 2)
    assert list(folder.kept_best(0)) == [2]
    shares[3] = 0.25  # another machine comes to another result
    for iteration in (3, 4):
        evaluate(second, iteration)
    assert list(folder.kept_best(0)) == [2]


def test_the_best_parameters_are_found_by_their_iteration(tmp_path, monkeypatch):
    name = "best-seed0-iteration2.safetensors"
    (tmp_path / name).touch()
    (tmp_path / "best-seed0-iteration4.safetensors").touch()  # after the metrics end
    rows = [{"seed": 0, "iteration": i, "greedy_overall": x} for i, x in ((1, 0.0), (2, 0.5))]
    entry = training.AlgorithmRun("ppo", RunFolder(tmp_path), Run(Config()), rows)
    policy = Policy("x", Config(), {"parameters": 0}, 2)
    monkeypatch.setattr(pretrained, "load_policy", {tmp_path / name: policy}.__getitem__)
    played = evaluation.Evaluation(jnp.array([True, False]), jnp.array([3, 6]), *2 * [jnp.zeros(2)])
    evaluator: Any = lambda params: {"p": played} if params == policy.params else None  # noqa: E731
    assert reporting.best_steps(entry, 0, Protocol(), evaluator) == {"p": [3, 0]}


def test_a_higher_threshold_continues_to_the_same_bits(tmp_path, monkeypatch):
    """Solved of four tasks are as many as there were iterations."""

    def evaluate(agent, params, env, tasks, shards):
        iteration = jax.tree.leaves(params)[0].reshape(-1)[0] % 100
        nothing = jnp.zeros(4, jnp.int32)
        return evaluation.Evaluation(jnp.arange(4) < iteration, nothing, nothing, nothing)

    monkeypatch.setattr(programs, "evaluate", evaluate)
    sizes = {"max_steps": 6, "filters": (2, 2), "hidden": 4, "embedding": 2, "curiosity": "none"}

    def train(name, share):
        run = Run(Config(**sizes, iterations=9, stop_when_solved=share))
        folder = RunFolder(tmp_path / name)
        if not folder.path.exists():
            RunFolder.create(folder.path, run)
        console = Console(file=io.StringIO())
        part = session.Session(
            folder, run, console, checkpoint_every=3, keep=1, placement=Placement()
        )
        part.train(stopping.StopSignals(lambda: None))
        part.summarize()
        part.close()
        return contents(folder.path)

    assert len(train("mine", 0.5)["metrics"]) == 2
    extended = train("mine", 1.0)
    assert len(extended["metrics"]) == 4
    assert extended == train("whole", 1.0)
    first = json.loads((tmp_path / "mine" / "summary.json").read_text())["seeds"][0]
    assert first["first_solved"]["iteration"] == 4
    with pytest.raises(ValueError, match="would be after iteration 3, but it is after 4"):
        train("mine", 0.75)


@pytest.mark.slow
def test_the_quick_protocol_runs(tmp_path):
    """A slice of it, as a process: one short iteration of real training, all sets."""
    settings = [
        "episodes_per_iteration=2",
        "minibatch_size=2",
        "epochs=1",
        "max_steps=4",
        "encode_chunk_size=8",
        *SMALL,
    ]
    counts = ["--iterations", "1", "--tasks", "1", "--evaluate-every", "1", "--algorithms", "ppo"]
    command = [sys.executable, "-W", "error", "-m", "agents.experiments", "exp1", "--quick"]
    done = subprocess.run(
        [
            *command,
            *counts,
            "--reported",
            "2",
            "--settings",
            *settings,
            "--out",
            str(tmp_path),
        ],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    (entry,) = json.loads((tmp_path / "exp1-fast-quick/summary.json").read_text())["algorithms"]
    (trial,) = entry["runs"]
    assert list(trial["best"]["steps"]) == list(ALL_SETS)
