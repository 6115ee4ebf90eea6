import csv
import dataclasses
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from scipy import stats

import trap_tube_jax as tt
from agents import pretrained
from agents.acting import evaluation
from agents.config import PRESETS, Config
from agents.experiments import __main__ as experiments
from agents.experiments import (
    figures,
    records,
    reporting,
    statistics,
    tables,
    training,
)
from agents.experiments.protocol import PROTOCOLS, QUICK, Protocol, algorithms
from agents.parallel.sharding import ALONE
from agents.ppo.learner import make_train
from agents.runs import machine, report, session, stopping, tracking
from agents.runs.checkpoint import Checkpoints, digest, to_arrays
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import TIMING_COLUMNS, MetricsLog, read_metrics
from benchmarks import readme_tables
from trap_tube_jax.scoring.tasks import ALL_SETS

ROOT = Path(__file__).parent.parent
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


class Killed(BaseException):
    """Nothing in the way of a process that is killed catches it."""


def fake_train(config, shards=ALONE):
    """Training at once: every parameter becomes 100 * seed + iteration."""
    real = make_train(config, shards=shards)
    shapes = jax.eval_shape(real.init, jax.random.key(0))._replace(key=None)

    def init(key):
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return zeros._replace(key=key)

    def iterate(state):
        iteration, seed = state.iteration + 1, jax.random.key_data(state.key)[-1]
        state = state._replace(
            params=jax.tree.map(lambda x: jnp.zeros_like(x) + 100 * seed + iteration, state.params),
            iteration=iteration,
            episodes=state.episodes + 8,
            transitions=state.transitions + 48,
        )
        return state, {"success": jnp.float32(0.25)}

    return real._replace(init=init, iterate=iterate)


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


def fake_evaluate(agent, params, env, tasks, chunk, shards):
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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "make_train", fake_train)
        patch.setattr(session, "evaluate", fake_evaluate)
        patch.setattr(report, "save_curves", lambda *args: None)
        for module in (tracking, reporting):
            patch.setattr(module, "Evaluator", FakeEvaluator)
        for module in (training, reporting):
            patch.setattr(module, "draw_tasks", lambda *args: tasks)
        one_step = lambda states: np.ones(len(states.time), np.int32)  # noqa: E731
        patch.setattr(reporting, "shortest_lengths", one_step)
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
        "--no-cache",
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
    best = [pretrained.load(path) for path in sorted(folder.glob("best-*.npz"))]
    return {
        "metrics": untimed(run_folder.metrics),
        "outcomes": untimed(run_folder.outcomes) if run_folder.outcomes.exists() else None,
        "state": digest(arrays),
        "best": [(policy.iteration, digest(to_arrays(policy.params))) for policy in best],
    }


@pytest.fixture(scope="module")
def whole(lab, tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def record(whole):
    return json.loads((whole / "summary.json").read_text())


@pytest.mark.slow
def test_evaluations_are_in_the_metrics(whole):
    for seed in (0, 1):
        rows = untimed(whole / f"ppo-seed{seed}" / "metrics.csv")
        assert [row["iteration"] for row in rows] == [str(i + 1) for i in range(ITERATIONS)]
        for row in rows:
            played = STEPS.get((seed, int(row["iteration"])), {"base": [np.nan], "p": [np.nan]})
            shares = [np.mean(np.sign(played[name])) for name in ("base", "p")]
            found = [float(row[f"greedy_{name}"]) for name in ("base", "p", "overall")]
            np.testing.assert_array_equal(found, [*shares, np.mean(shares)])


@pytest.mark.slow
def test_the_steps_of_every_task_are_kept(whole):
    for seed in (0, 1):
        for row in read_metrics(whole / f"ppo-seed{seed}" / "outcomes.csv"):
            played = tracking.outcome(row)
            for name, steps in STEPS[seed, int(row["iteration"])].items():
                solved, taken = played[name]
                assert taken.tolist() == steps
                assert solved.tolist() == [count > 0 for count in steps]


@pytest.mark.slow
def test_the_best_parameters_are_kept(whole):
    for seed, iteration in ((0, 4), (1, 2)):
        policy = pretrained.load(whole / f"ppo-seed{seed}" / f"best-seed{seed}.npz")
        assert policy.iteration == iteration
        assert np.all(jax.tree.leaves(policy.params)[0] == 100 * seed + iteration)


@pytest.mark.slow
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
    scores = statistics.seed_scores(record, entry, trial)
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


@pytest.mark.slow
def test_the_papers_selection_reports_what_it_chose_by(whole, record, tmp_path):
    root = run(tmp_path, "--selection", "paper")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reporting, "Evaluator", lambda config, tasks: None)  # nothing is played
        again = run(tmp_path, "--selection", "paper")
    found = records.read_record(again / "summary.json")
    runs = [entry["runs"] for entry in (record["algorithms"][0], found["algorithms"][0])]
    assert [trial["best"]["steps"] for trial in runs[1]] == [
        trial["best"]["steps"] for trial in runs[0]
    ]
    assert "--selection paper" in found["command"]
    assert "chosen and reported on the same 4 tasks" in (root / "tables.md").read_text()
    assert "on 4 validation tasks a set; reported are 1,000 other tasks" in (
        (whole / "tables.md").read_text()
    )
    assert not list(root.glob("*/tested-*"))


@pytest.mark.slow
def test_an_experiment_leaves_tables_and_figures(whole, record, capsys):
    assert figures.drawn_from(whole / "curves.png") == figures.digest(record)
    text = (whole / "tables.md").read_text()
    assert "| PPO + ICM, paper | 5 / 5 | 102,000 ± 60,000 |" in text
    assert tables.markdown(record) in text
    before = (whole / "summary.json").read_bytes()
    where = ["--out", str(whole.parent), "--name", "x"]
    experiments.main(["exp1", *where, "--report-only", "--no-cache"])
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


@pytest.mark.slow
def test_killed_experiments_continue_to_the_same_bits(whole, tmp_path):
    """Killed in a fourth iteration, one past a checkpoint, after each of its writes.

    The evaluation of the fourth iteration is the best of seed 0, and not of seed 1.
    """

    def appended(column, seed):
        return lambda log, rows: (
            column in rows[0] and (rows[0]["seed"], rows[0]["iteration"]) == (seed, 4)
        )

    moments = [
        (MetricsLog, "append", appended("p/00000", seed=0)),
        (pretrained, "save", lambda path, policy: policy.iteration == 4),
        (MetricsLog, "append", appended("success", seed=1)),
    ]
    for moment in moments:
        with pytest.MonkeyPatch.context() as patch:
            kill_after(patch, *moment)
            with pytest.raises(Killed):
                run(tmp_path)
    run(tmp_path)
    for name in ("ppo-seed0", "ppo-seed1"):
        assert contents(tmp_path / "x" / name) == contents(whole / name)


@pytest.mark.slow
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


@pytest.mark.slow
def test_seeds_side_by_side_are_those_one_after_another(whole, tmp_path):
    folder = run(tmp_path, "--side-by-side") / "ppo-seed0to1"
    for name in ("metrics.csv", "outcomes.csv"):
        rows = untimed(folder / name)
        for seed in (0, 1):
            alone = untimed(whole / f"ppo-seed{seed}" / name)
            assert [row for row in rows if row["seed"] == str(seed)] == alone
    assert [pretrained.load(folder / f"best-seed{i}.npz").iteration for i in (0, 1)] == [4, 2]


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as exit_info:
        experiments.main([*map(str, arguments), "--no-cache"])
    assert exit_info.value.code == 2
    captured = capsys.readouterr()
    return " ".join(re.sub("[│╭╰─╮╯]", " ", captured.err + captured.out).split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algorithms ppo icm", f"unknown algorithm 'icm'; allowed: {', '.join(algorithms())}"),
        ("--preset slow", "unknown preset 'slow'; allowed: paper, fast"),
        ("--seeds 0", "seeds must be >= 1, got 0"),
        ("--reported 0", "reported must be >= 1, got 0"),
        ("--algorithms ppo+imitation", "imitates, but imitation_coef is 0 in preset 'paper'"),
        ("--evaluate-every 0", "evaluate_every must be >= 1, got 0"),
        ("--checkpoint-every 0", "checkpoint_every must be >= 1, got 0"),
        ("--iterations 0", "iterations must lie in [1, inf], got 0"),
        ("--settings hiden=4", "unknown setting 'hiden'; did you mean 'hidden'?"),
        ("--settings hidden", "settings are given as NAME=VALUE, got 'hidden'"),
        ("--name a/b", "name must be the name of a folder, without a path, got 'a/b'"),
        ("--report-only", "exp1-paper holds no experiment"),
    ],
)
def test_impossible_experiments_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, "exp1", *arguments.split(), "--out", tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_folder_holds_one_experiment(capsys, whole):
    where = ["--out", whole.parent, "--name", "x"]
    assert "holds another experiment than exp2" in refused(capsys, "exp2", *where)
    assert "x has tasks=4, not 5; use another --name" in refused(
        capsys, "exp1", *where, "--tasks", 5
    )


def test_protocols_are_the_papers():
    assert (PROTOCOLS["exp1"].iterations, PROTOCOLS["exp2"].iterations) == (250, 500)
    for protocol in PROTOCOLS.values():
        assert (protocol.preset, protocol.seeds, protocol.tasks) == ("paper", 5, 128)
        assert protocol.algorithms == ("ppo", "ppo+icm")
        config = protocol.config("ppo+icm")
        assert (config.curiosity, config.episodes, config.stop_when_solved) == ("icm", 1024, 0)
        assert protocol.config("ppo").curiosity == "none"
        assert (protocol.selection, protocol.num_reported) == ("validation", 1000)
    fast = QUICK["exp1"].config("preset")
    assert (fast.curiosity, fast.imitation_coef, fast.eval_episodes) == ("counts", 1.0, 16)


def test_stored_protocols_are_whole():
    """An old one did not say on which tasks its evaluations were chosen."""
    values = json.loads(json.dumps(dataclasses.asdict(PROTOCOLS["exp1"])))
    assert Protocol.from_dict(values) == PROTOCOLS["exp1"]
    del values["selection"]
    with pytest.raises(ValueError, match="a protocol lacks selection"):
        Protocol.from_dict(values)


def test_folders_of_earlier_versions_hold_the_papers_sets(tmp_path):
    usual = PROTOCOLS["exp2"]
    values = {"experiment": "exp2", **dataclasses.asdict(usual)}
    for name in ("train_set", "sets", "imports"):
        del values[name]
    (tmp_path / "experiment.json").write_text(json.dumps(values))
    assert training.open_experiment(tmp_path, "exp2", usual, {}, create=False) == usual
    with pytest.raises(ValueError, match="has train_set=pstsy, not sy; use another --name"):
        training.open_experiment(tmp_path, "exp2", usual, {"train_set": "sy"}, create=False)


def test_any_sets_are_trained_and_evaluated_on():
    options = experiments.Options("exp1", train_set="SymbolicTrapTube-v0", sets=("base", "psy"))
    assert options.root.name == "exp1-paper-sy"
    protocol = dataclasses.replace(options.defaults, **options.given())
    assert (protocol.train_set, protocol.sets) == ("sy", ("base", "psy"))
    assert protocol.config("ppo").env_id == "SymbolicTrapTube-v0"
    assert " --train-set sy --sets base psy --preset " in protocol.command("exp1", ["ppo"])
    # Base, a single task, is ranked by only where it is trained on.
    assert protocol.ranked == ("psy",)
    assert dataclasses.replace(protocol, train_set="base").ranked == ("base", "psy")
    assert dataclasses.replace(protocol, sets=("base",)).ranked == ("base",)
    assert [PROTOCOLS[name].ranked for name in PROTOCOLS] == [ALL_SETS, ALL_SETS[1:]]
    with pytest.raises(ValueError, match="unknown task set 'q'"):
        dataclasses.replace(protocol, sets=("q",))
    with pytest.raises(ValueError, match="name at least one task set; allowed: base, p"):
        dataclasses.replace(protocol, sets=())


@pytest.mark.parametrize("experiment", PROTOCOLS)
def test_the_papers_numbers_stand_beside_its_own_sets_only(example, experiment):
    example["experiment"] = experiment
    example["protocol"]["train_set"] = PROTOCOLS[experiment].train_set
    assert "PPO + ICM, paper" in tables.markdown(example)
    assert tables.title(example).startswith("Experiment ")
    example["protocol"]["train_set"] = "sy"
    assert ", paper" not in tables.markdown(example)
    assert tables.title(example) == "Train on {Sy}, preset paper"
    assert ("{Sy} solved; " in tables.markdown(example)) == (experiment == "exp1")


@pytest.mark.parametrize("preset", PRESETS)
def test_ppo_is_ppo_alone_in_every_preset(preset):
    learner = {"method": "ppo"} if "method" in PRESETS[preset] else {}
    protocol = Protocol(preset=preset, settings=learner)
    whole = protocol.config("preset")
    for name in ("ppo", "ppo+icm", "ppo+counts"):
        config = protocol.config(name)
        assert config.imitation_coef == 0
        assert config.curiosity == (name.partition("+")[2] or "none")
        assert config.learning_rate == whole.learning_rate
    assert not protocol.config("ppo").episodic_novelty


def test_a_name_may_say_that_the_agent_imitates():
    fast = Protocol(preset="fast")
    whole = fast.config("preset")
    assert whole.imitation_coef > 0
    named = fast.config(f"ppo+{whole.curiosity}+imitation")
    assert named == whole
    plain = fast.config("ppo+imitation")
    assert (plain.curiosity, plain.imitation_coef) == ("none", whole.imitation_coef)


def test_runs_with_a_cooldown_are_not_extended(tmp_path):
    short = Protocol(algorithms=("ppo",), seeds=1, settings={"cooldown": 0.5}, iterations=4)
    training.plan(tmp_path, short, side_by_side=False)
    longer = dataclasses.replace(short, iterations=8)
    with pytest.raises(ValueError, match=r"ppo-seed0: the run has cooldown=0.5 and iterations=4"):
        training.plan(tmp_path, longer, side_by_side=False)


def test_a_higher_threshold_continues_to_the_same_bits(tmp_path, monkeypatch):
    """Solved of four tasks are as many as there were iterations."""

    def evaluate(agent, params, env, tasks, chunk, shards):
        iteration = jax.tree.leaves(params)[0].reshape(-1)[0] % 100
        nothing = jnp.zeros(4, jnp.int32)
        return evaluation.Evaluation(jnp.arange(4) < iteration, nothing, nothing, nothing)

    monkeypatch.setattr(session, "evaluate", evaluate)
    sizes = {"max_steps": 6, "filters": (2, 2), "hidden": 4, "embedding": 2, "curiosity": "none"}

    def train(name, share):
        run = Run(Config(**sizes, iterations=9, stop_when_solved=share))
        folder = RunFolder(tmp_path / name)
        if not folder.path.exists():
            RunFolder.create(folder.path, run)
        console = Console(file=io.StringIO())
        part = session.Session(folder, run, console, checkpoint_every=3, keep=1)
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


def rows(seed, greedy, iterations=None):
    return [
        {
            "seed": seed,
            "iteration": index + 1,
            "episodes": 1024 * (index + 1),
            "transitions": 1000 * (index + 1),
            "evaluation": greedy[index],
            "success": greedy[index] / 2,
            "greedy_p": float("nan") if index % 2 else greedy[index],
            "greedy_overall": float("nan") if index % 2 else greedy[index],
            "seconds": 2.0 * (index + 1),
        }
        for index in range(len(greedy) if iterations is None else iterations)
    ]


MACHINE = {
    "processor": "any",
    "cores": 2,
    "device": "cpu",
    "devices": 1,
    "jax": "0",
    "commit": "abc",
}


def example_record(tmp_path, greedy, iterations):
    """Runs with these evaluations; in test tasks they take 10 * seed, 20 and 0 steps."""
    entries = []
    for seed, values in enumerate(greedy):
        config = Protocol(iterations=iterations).config("ppo+icm")
        made = Run(config, seed=seed)
        folder = RunFolder.create(tmp_path / f"ppo+icm-seed{seed}", made)
        entries.append(training.AlgorithmRun("ppo+icm", folder, made, rows(seed, values)))
    machines = [MACHINE]
    runs = [
        records.seed_record(
            entry,
            entry.run.seed,
            machines=machines,
            evaluate_every=1,
            steps={"base": [11], "p": [10 * entry.run.seed, 20, 0]},
        )
        for entry in entries
    ]
    config = entries[0].run.config.to_dict()
    about = {"max_steps": 50, "equal_to_base": 25.0, "layout": None, "shortest": [5, 10, -1]}
    return {
        "schema": records.SCHEMA,
        "experiment": "exp2",
        "command": "x",
        "protocol": dataclasses.asdict(Protocol(train_set="pstsy", iterations=iterations)),
        "ranked": ["p"],
        "machines": machines,
        "sets": {"base": {**about, "layout": [0], "shortest": [11]}, "p": about},
        "algorithms": [{"name": "ppo+icm", "config": config, "runs": runs}],
    }


@pytest.fixture
def example(tmp_path):
    return example_record(tmp_path, [[0, 0, 0], [0, 1, 0], [0, 0, 0, 1]], iterations=4)


def test_tables_hold_means_deviations_and_intervals(example):
    (entry,) = example["algorithms"]
    # 2,048 and 4,096 episodes; solved 1, 2 and 2 of 3 tasks, of which one is unsolvable.
    episodes = statistics.Spread.of(statistics.episodes_to_solve(entry))
    assert episodes == pytest.approx((3072, 1448.15, 12.7062 * 1024), abs=0.1)
    p = statistics.by_set(example, entry)["p"]
    half_width = 4.3027 * 19.245 / 3**0.5
    assert p.percent == pytest.approx((500 / 9, 19.245, half_width), abs=1e-3)
    assert p.percent_of_solvable == pytest.approx((250 / 3, 28.868, 71.712), abs=1e-3)
    assert p.optimality is not None
    assert p.optimality.mean == pytest.approx((0.5 + 0.5 + 0.375) / 3)
    assert p.worst == 0.25
    text = tables.markdown(example)
    assert "| {P} | 55.6 ± 19.2 [7.7, 100.0] | 0.0 | 2.0 ± 3.0 |" in text
    assert "| mean of the sets apart from base | 55.6 ± 19.2 [7.7, 100.0] | – | – |" in text
    assert "| base | 1.0 of 1 |" in text
    assert "| {P} | 3 | 83.3 ± 28.9 [11.6, 100.0] | 0.458 ± 0.072 [0.279, 0.638] | 0.250 |" in text
    assert "Unfinished: ppo+icm, seed 0, 3 of 4 iterations." in text
    assert "Unfinished: ppo+icm, seed 1, 3 of 4 iterations." in text
    assert "seed 2" not in text
    example["experiment"] = "exp1"
    row = ("PPO + ICM", "2 / 3", "3,072 ± 1,448 [0, 16,083]")
    assert tables.solved_table(example).rows[0] == row
    assert tables.percent_table(example).rows[1] == ("{P}", "55.6 ± 19.2 [7.7, 100.0]", "25.0")
    assert tables.cost_table(example).rows == (("PPO + ICM", "3", "3–4", "3,333", "0:07"),)


@pytest.mark.parametrize("degrees", [1, 2, 9, 30, 31, 100])
def test_student_t(degrees):
    assert statistics.student_t(degrees) == pytest.approx(stats.t.ppf(0.975, degrees), abs=6e-5)


def test_one_seed_has_neither_deviation_nor_interval():
    assert statistics.Spread.of([3.0, None]) == (3.0, None, None)
    assert statistics.Spread.of([None]) is None
    with pytest.raises(ValueError, match="degrees must be >= 1, got 0"):
        statistics.student_t(0)


def test_records_come_back_as_they_were_written(example, tmp_path):
    path = tmp_path / "new" / "x.json"
    records.write_record(path, example)
    assert tables.markdown(records.read_record(path)) == tables.markdown(example)
    assert figures.digest(records.read_record(path)) == figures.digest(example)
    assert '"shortest": [5, 10, -1]' in path.read_text()
    records.write_record(path, {**example, "schema": "trap-tube-jax experiment 0"})
    with pytest.raises(ValueError, match="schema 'trap-tube-jax experiment 0'; allowed: 'trap-"):
        records.read_record(path)
    path.write_text("[]")
    with pytest.raises(ValueError, match="is no record of an experiment"):
        records.read_record(path)


def test_records_are_of_committed_code(example, monkeypatch):
    def check(commit, own, given=None):
        monkeypatch.setattr(records, "machine", lambda: {"commit": own})
        records.check_clean({**example, "machines": [{**MACHINE, "commit": commit}]}, given)

    check("abc", "def")
    check("abc", None, given="def")
    for commit, own in (("abc-dirty", "def"), ("abc", "def-dirty")):
        with pytest.raises(ValueError, match=r"committed code, this one of .*-dirty; commit the"):
            check(commit, own)
    for commit, own in ((None, "def"), ("abc", None)):
        with pytest.raises(ValueError, match="which git does not tell; give --commit"):
            check(commit, own)


def test_curves_are_thinned_at_the_same_points_for_all_seeds():
    long, short = (rows(0, [0.5] * n) for n in (1000, 333))
    for row in (*long, *short):
        row["greedy_p"] = row["greedy_overall"] = 0.123456 if row["iteration"] % 3 == 0 else np.nan
    found = [records.curves(each, 1000, 3) for each in (long, short)]
    assert found[0]["training"]["iteration"] == list(range(5, 1001, 5))
    assert found[1]["training"]["iteration"] == [*range(5, 333, 5), 333]
    assert found[0]["greedy"]["iteration"] == [*range(6, 1000, 6), 999]
    assert found[0]["greedy"]["greedy_p"][0] == 0.1235
    back = records.rows_of({"seed": 7, "curves": found[0]})
    assert len(back) == len(found[0]["training"]["iteration"]) + len(
        found[0]["greedy"]["iteration"]
    )
    assert {row["seed"] for row in back} == {7}


def test_a_commit_is_dirty_where_code_changed(tmp_path, monkeypatch):
    def git(*arguments):
        given = ["git", "-c", "user.name=x", "-c", "user.email=x@x", *arguments]
        subprocess.run(given, cwd=tmp_path, check=True, capture_output=True)

    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "a.py").write_text("1\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "x")
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    clean = machine.machine()["commit"]
    assert re.fullmatch(r"[0-9a-f]{12}", clean)
    (tmp_path / "record.json").write_text("{}")
    assert machine.machine()["commit"] == clean
    (tmp_path / "agents" / "a.py").write_text("2\n")
    assert machine.machine()["commit"] == f"{clean}-dirty"


def test_curves_are_drawn_of_seeds_of_any_length(example, tmp_path):
    some = [*rows(0, [0.0, 0.5, 1.0]), *rows(1, [0.25])]
    episodes, values = figures.by_iteration(some, "greedy_p")
    assert episodes.tolist() == [1024, 3072]
    np.testing.assert_array_equal(values, [[0, 1], [0.25, np.nan]])
    for experiment in PROTOCOLS:
        example["experiment"] = experiment
        figures.save(example, tmp_path / "x.png")
        assert figures.drawn_from(tmp_path / "x.png") == figures.digest(example)
    assert figures.drawn_from(tmp_path / "none.png") is None


def test_pages_and_figures_are_those_of_the_records():
    found = readme_tables.read_records(readme_tables.Arguments().results)
    assert not readme_tables.stale(readme_tables.ROOT, found)
    page = readme_tables.Arguments().results / "fast_preset.md"
    assert readme_tables.BLOCK.search(page.read_text())


def test_pages_and_figures_are_redrawn_on_demand(example, tmp_path, capsys):
    folder = tmp_path / "benchmarks" / "results"
    records.write_record(folder / "mine.json", example)
    (folder / "other.json").write_text("{}")
    block = "a\n<!-- table: {} -->\nold\n<!-- end -->\nb\n"
    (tmp_path / "README.md").write_text(block.format("mine"))
    (folder / "page.md").write_text(block.format("mine"))
    (folder / "absent.md").write_text(block.format("absent"))
    check, write = (readme_tables.Arguments(root=tmp_path, write=write) for write in (False, True))
    with pytest.raises(SystemExit):
        readme_tables.main(check)
    readme_tables.main(write)
    for page in (tmp_path / "README.md", folder / "page.md"):
        assert "PPO + ICM, paper" in page.read_text()
        assert "old" not in page.read_text()
    assert (folder / "absent.md").read_text() == block.format("absent")
    readme_tables.main(check)
    example["algorithms"][0]["runs"][0]["curves"]["training"]["success"][0] = 0.5
    records.write_record(folder / "mine.json", example)
    capsys.readouterr()
    with pytest.raises(SystemExit):
        readme_tables.main(check)
    assert "out of date: " + str(folder / "figures" / "mine.png") in capsys.readouterr().out
    with pytest.raises(ValueError, match="--write and --check exclude each other"):
        readme_tables.Arguments(write=True, check=True)


@pytest.mark.slow
def test_the_quick_protocol_runs(tmp_path):
    """A slice of it, as a process: one short iteration of real training, all sets."""
    settings = ["episodes=2", "minibatch=2", "epochs=1", "max_steps=4", "chunk=8", *SMALL]
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
            "--no-optimality",
            "--no-cache",
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
