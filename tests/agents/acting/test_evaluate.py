"""Greedy evaluation: fixed tasks, scores, tables and the page of a run."""

import base64
import html
import io
import json
import re
import shutil
import subprocess
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

import trap_tube_jax as tt
from agents import make_train
from agents.acting.evaluation import Evaluation, Evaluator
from agents.config import Config
from agents.networks.agent import Agent
from agents.ppo.learner import Learner
from agents.runs import report, report_page
from trap_tube_jax.dynamics import step
from trap_tube_jax.objects import DIRECTION_NAMES
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.scoring import benchmark
from trap_tube_jax.scoring.scores import Layouts, Optimality, Score, wilson_interval
from trap_tube_jax.scoring.tasks import (
    evaluation_keys,
    evaluation_tasks,
    fixed_tasks,
    layout_numbers,
)

TINY = {
    "episodes_per_iteration": 4,
    "minibatch_size": 2,
    "epochs": 1,
    "max_steps": 6,
    "filters": (2, 2),
    "hidden": 4,
    "embedding": 2,
    "encode_chunk_size": 3,
}
SHORTS = [entry.short for entry in PAPER_TASK_SETS]
# The food beside the agent, on each side in turn: whichever way the first move of a policy
# leads, it solves one of them.
FOOD_BESIDE = [(8, 1), (10, 1), (9, 0), (9, 2)]


def stack(states):
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def food_beside_agent(num_features):
    base = tt.base_state(num_features)
    return stack([base.replace(food=jnp.array(cell, jnp.int32)) for cell in FOOD_BESIDE])


def zeros_like(tree):
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), tree)


def random_params(config):
    """Parameters without the seconds that compiling their initialisers takes."""
    shapes = jax.eval_shape(Agent(config).init, jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)


@pytest.fixture(scope="module")
def grey_play():
    """A random policy on grey boards: every set's tasks, and an own set of known outcome."""
    config = Config(**TINY, num_features=1)
    tasks = {name: evaluation_tasks(name, 2, 1) for name in ("base", "p")}
    evaluator = Evaluator(config, {**tasks, "mine": food_beside_agent(1)})
    params = random_params(config)
    return evaluator, params, evaluator(params)


@pytest.mark.parametrize("name", SHORTS)
def test_tasks_are_the_same_at_every_call(name):
    tasks = evaluation_tasks(name, 3)
    assert_equal(tasks, evaluation_tasks(tt.task_set(name).id, 3))
    assert len(tasks.time) == (1 if name == "base" else 3)


def test_tasks_are_those_that_the_environment_draws():
    keys = evaluation_keys("PerceptualSymbolicTrapTube-v0", 3)
    drawn, _ = jax.jit(jax.vmap(tt.make("psy").reset))(keys)
    assert_equal(evaluation_tasks("psy", 3), drawn)


def test_more_tasks_begin_with_the_same_ones():
    few, many = evaluation_tasks("sy", 3), evaluation_tasks("sy", 5)
    assert_equal(few, jax.tree.map(lambda x: x[:3], many))


def test_keys_differ_within_and_between_sets_and_purposes():
    keys = [
        jax.random.key_data(evaluation_keys(entry.id, 64, purpose))
        for entry in PAPER_TASK_SETS
        for purpose in ("test", "validation")
    ]
    assert len(np.unique(np.concatenate(keys), axis=0)) == 64 * len(keys)


def test_keys_of_tasks_are_never_drawn_in_training(monkeypatch):
    """Playing with recorded keys: what a transfer gets is fixed by what `reset` gets."""
    seen = []
    nothing_learnt = lambda learner, state, *_: (state.params, state.opt_state, {})  # noqa: E731
    monkeypatch.setattr(Learner, "optimize", nothing_learnt)

    def record(key, state):
        data = jax.random.key_data(key)
        jax.debug.callback(lambda data: seen.append(tuple(np.ravel(data))), data)
        return state

    env = tt.Environment((record,), max_steps=6)
    config = Config(**TINY, curiosity="none")
    train = make_train(config, env)
    seen.clear()
    first_key = jax.jit(lambda key: train.init(key).key)
    zeros = zeros_like(jax.eval_shape(train.init, jax.random.key(0))._replace(key=None))
    iterate = jax.jit(train.iterate)
    for seed in range(3):
        state = zeros._replace(key=first_key(jax.random.key(seed)))
        for _ in range(2):
            state, _ = iterate(state)
    jax.effects_barrier()
    training = set(seen)
    assert len(training) == 3 * 2 * config.episodes_per_iteration

    seen.clear()
    for entry in PAPER_TASK_SETS:
        fixed_tasks(env, entry.id, 8)
        fixed_tasks(env, entry.id, 8, "validation")
    jax.effects_barrier()
    assert len(set(seen)) == 2 * 8 * len(PAPER_TASK_SETS)
    assert not training & set(seen)


def test_outcomes_are_those_of_the_recorded_actions(grey_play):
    evaluator, _, played = grey_play
    step = jax.jit(tt.Environment(base=tt.base_state(1), max_steps=6).step)
    for name, tasks in evaluator.tasks.items():
        for index, solved in enumerate(played[name].solved):
            state = jax.tree.map(lambda x, index=index: x[index], tasks)
            actions = played[name].action[index, : played[name].length[index]]
            for action in actions:
                assert not state.terminated
                state, _ = step(state, jnp.asarray(action))
            assert state.terminated == solved
            assert state.terminated | state.truncated


def test_own_tasks_are_evaluated(grey_play):
    evaluator, _, played = grey_play
    outcome = played["mine"]
    assert outcome.solved.any()
    assert 1 in outcome.length[outcome.solved]
    assert not played["base"].solved.any()  # needs 11 steps, has 6
    by_set = {score.set: score for score in evaluator.scores(played)}
    assert by_set["mine"].percent == 25 * outcome.solved.sum()
    assert by_set["mine"].interval is not None
    assert by_set["base"].interval is None
    assert by_set["base"].mean_steps is None


def test_blocks_change_nothing(grey_play, monkeypatch):
    evaluator, params, played = grey_play
    monkeypatch.setattr(benchmark, "BLOCK", 3)
    blocks = Evaluator(Config(**TINY, num_features=1), evaluator.tasks)
    assert_equal(blocks(params), played)


def test_each_set_has_its_own_limit_where_the_settings_leave_it(grey_play, own_task_sets):
    """With a limit of 6 for both, and with 1 and 6: what took longer than 1 is not solved."""
    evaluator, params, played = grey_play
    for name, limit in (("one", 1), ("six", 6)):
        tt.register(name, (), base=tt.base_state(1), max_steps=limit)
    tasks: dict[str, tt.State] = dict.fromkeys(("one", "six"), evaluator.tasks["mine"])
    config = Config(**{**TINY, "max_steps": None}, num_features=1)
    own = Evaluator(config, tasks)
    assert own.limits == {"one": 1, "six": 6}
    outcome = own(params)
    for name in ("solved", "length"):
        found, expected = (getattr(each, name) for each in (outcome["six"], played["mine"]))
        np.testing.assert_array_equal(found, expected)
    at_once = played["mine"].solved & (played["mine"].length == 1)
    assert 0 < at_once.sum()
    np.testing.assert_array_equal(outcome["one"].solved, at_once)
    np.testing.assert_array_equal(outcome["one"].length, 1)
    assert Evaluator(Config(**TINY, num_features=1), tasks).limits == {"one": 6, "six": 6}
    with pytest.raises(ValueError, match="unknown task set 'mine'"):
        Evaluator(config, {"mine": tasks["one"]})


@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_is_a_table_on_a_terminal_and_lines_elsewhere(is_terminal):
    """A table as wide as the terminal allows; a line with all metrics for each iteration."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=is_terminal, width=60)
    with report.LiveReport(console, total_iterations=5, num_seeds=2) as live:
        for iteration in (1, 2):
            row = dict.fromkeys((name for _, name, _ in report.LIVE_COLUMNS), 0.5)
            live.update([row | {"iteration": iteration, "episodes": 7000 + iteration}] * 2, 1)
    text = file.getvalue()
    assert "7,001" in text
    assert "1/2 solved" in text
    assert "left at most" in text
    assert ("iteration 2 of 5" in text) == is_terminal
    assert ("entropy" in text) != is_terminal


def test_compiling_does_not_count_in_what_is_left(monkeypatch):
    now = iter([0.0, 0.0, 100.0])
    monkeypatch.setattr(report, "time", SimpleNamespace(perf_counter=lambda: next(now)))
    file = io.StringIO()
    row = dict.fromkeys((name for _, name, _ in report.LIVE_COLUMNS), 0.5)
    with report.LiveReport(Console(file=file), total_iterations=5, num_seeds=1) as live:
        live.update([row | {"iteration": 1}], 0, ready_at=98.0)
    assert "0:08 left at most" in file.getvalue()


def test_solved_episode_becomes_a_gif(grey_play, tmp_path):
    evaluator, _, played = grey_play
    path = tmp_path / "solved.gif"
    assert report.save_first_solved(path, evaluator, [played], prefer="base") == "mine"
    with Image.open(path) as picture:
        index = int(np.argmax(played["mine"].solved))
        assert getattr(picture, "n_frames", 1) == played["mine"].length[index] + 1


def test_no_solved_episode_leaves_no_gif(grey_play, tmp_path):
    evaluator, _, played = grey_play
    unsolved = {"base": played["base"]}
    assert report.save_first_solved(tmp_path / "x.gif", evaluator, [unsolved], "base") is None
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def page(grey_play, tmp_path_factory):
    """The page of a run, and the data that its script reads."""
    evaluator, _, played = grey_play
    folder = tmp_path_factory.mktemp("page")
    Image.new("RGB", (4, 4)).save(folder / "curves.png")
    path = folder / "report.html"
    report_page.save(
        path,
        title="<mine>",
        sentences=["It does not transfer."],
        settings={"hidden": 4},
        scores={"seed 0": evaluator.scores(played)},
        curves=folder / "curves.png",
        evaluator=evaluator,
        played=played,
        pay=lambda tasks, counts: jnp.broadcast_to(jnp.arange(50.0), (len(counts), 50)),
    )
    start, end = '<script type="application/json" id="data">', "</script>"
    return path, json.loads(path.read_text().partition(start)[2].partition(end)[0])


def test_a_page_needs_no_network_and_holds_the_settings(page):
    text = page[0].read_text()
    assert "<h1>&lt;mine&gt;</h1>" in text
    assert "<td>hidden</td><td>4</td>" in text
    assert "<td>{P} (p)</td><td>2</td>" in text
    assert not re.search(r"https?:|(src|href)=\"(?!data:)", text)


def test_a_page_shows_solved_and_unsolved_episodes(grey_play, page):
    outcome, data = grey_play[2]["mine"], page[1]
    solved, unsolved = (int(np.argmax(outcome.solved == which)) for which in (True, False))
    mine = [each for each in data["episodes"] if each["title"].startswith("mine")]
    assert [each["title"] for each in mine] == [
        f"mine, task {solved}: solved",
        f"mine, task {unsolved}: not solved",
    ]
    for index, each in zip((solved, unsolved), mine, strict=True):
        length = outcome.length[index]
        assert len(each["frames"]) == length + 1
        assert len(each["actions"]) == length
        np.testing.assert_allclose(each["values"], outcome.value[index, :length], atol=1e-4)
        assert each["novelty"] == list(range(length))
        for number in each["frames"]:
            with Image.open(io.BytesIO(base64.b64decode(data["pictures"][number]))) as picture:
                assert picture.size == (192, 192)


def test_a_page_shows_shortest_plans(grey_play, page):
    """From the same board as the episode, and with as many steps as are needed."""
    for each in page[1]["episodes"]:
        steps = {"base": 11, "mine": 1}.get(each["title"].partition(",")[0])
        plan = each["plan"]
        assert len(plan["frames"]) == len(plan["actions"]) + 1
        if steps is not None:
            assert len(plan["actions"]) == steps
        name, _, number = each["title"].partition(":")[0].partition(", task ")
        name = {"{P}": "p"}.get(name, name)
        state = jax.tree.map(lambda x, i=int(number): x[i], grey_play[0].tasks[name])
        first = DIRECTION_NAMES.index(plan["actions"][0].split()[1].rstrip(","))
        shown = report_page._png(np.asarray(tt.render(state, 16, grasp=first)).tobytes())
        assert page[1]["pictures"][plan["frames"][0]] == base64.b64encode(shown).decode()


def test_a_page_shows_what_the_curiosity_pays():
    """Counts of this play alone: the same task twice, then once, beside one that does not count."""
    config = Config(**TINY, curiosity="counts")
    trained = jax.jit(make_train(config).init)(jax.random.key(0))
    evaluator = Evaluator.of_sets(config, ["base"], 1)
    pay = report_page.compile_pay(config, trained, evaluator)
    tasks = stack([tt.base_state()] * 2)
    both, one = (np.asarray(pay(trained, tasks, np.array([True, x]))) for x in (True, False))
    outcome = evaluator(trained.params)["base"]

    state, advance = tt.base_state(), jax.jit(step)
    seen = [np.asarray(tt.observe(state)).tobytes()]
    for action in outcome.action[0, : outcome.length[0]]:
        state = advance(state, action)
        seen.append(np.asarray(tt.observe(state)).tobytes())
    expected = np.array([seen[1:].count(board) ** -0.5 for board in seen[1:]])
    np.testing.assert_allclose(both, [expected / 2**0.5] * 2, rtol=1e-6)
    np.testing.assert_allclose(one, [expected, 0 * expected], rtol=1e-6)


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason=f"needs one of {', '.join(BROWSERS)}")
def test_a_browser_shows_a_page(page, tmp_path):
    """The page's script has run: it has filled in the episodes and the boards."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
    command = [str(BROWSER), *options, "--dump-dom", page[0].as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for each in page[1]["episodes"]:
        assert f">{html.escape(each['title'])}</option>" in shown
    assert re.search(r'<img id="board" [^>]*src="data:image/png', shown)
    assert "The agent: step 0 of " in shown
    assert "The shortest plan: step 0 of 11; next: grasp " in shown


def test_optimality_compares_with_shortest_plans():
    found = Optimality.of(
        solved=np.array([True, True, False, False, False]),
        length=np.array([10, 20, 50, 50, 50]),
        shortest=np.array([10, 5, -1, 51, 50]),
        max_steps=50,
    )
    assert found.solvable == 3
    assert found.percent_of_solvable == pytest.approx(200 / 3)
    assert (found.mean, found.worst) == (0.625, 0.25)
    nothing = Optimality.of(np.array([False]), np.array([50]), np.array([-1]), 50)
    assert nothing == Optimality(0, None, None, None)


def test_scores_use_the_paper_notation():
    outcome = Evaluation(jnp.array([True, False]), jnp.array([11, 50]), *[jnp.zeros((2, 50))] * 2)
    evaluator = Evaluator.of_sets(Config(), ["pst"], 2)
    (score,) = evaluator.scores({"pst": outcome}, {"pst": np.array([11, 12])})
    assert (score.label, score.tasks, score.solved, score.percent) == ("{P, St}", 2, 1, 50.0)
    assert score.mean_steps == 11
    assert score.optimality == Optimality(2, 50.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # R: binom::binom.confint(successes, trials, methods = "wilson").
    [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0)],
)
def test_wilson_interval(successes, trials, low, high):
    np.testing.assert_allclose(wilson_interval(successes, trials), (low, high), atol=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_interval_refuses(successes, trials):
    with pytest.raises(ValueError, match=r"\b(k|n)\b"):
        wilson_interval(successes, trials)


@pytest.mark.parametrize("name", SHORTS)
def test_sets_with_few_layouts_are_named(name):
    layout = layout_numbers(name, evaluation_tasks(name, 64))
    number = {"base": 1, "st": 1, "sy": 5, "stsy": 5}.get(name)
    assert (None if layout is None else len(set(layout.tolist()))) == number


def test_few_layouts_are_counted_and_have_no_interval():
    solved = np.array([True, True, False, True, False])
    layout = np.array([0, 0, 0, 1, 1])
    score = Score.of("stsy", "{St, Sy}", solved, np.full(5, 9), layout=layout)
    assert (score.percent, score.interval, score.layouts) == (60.0, None, Layouts(1, 2))
    assert str(score.layouts) == "1 of 2"
    assert Score.of("p", "{P}", solved, np.full(5, 9)).layouts is None


def test_a_narrow_terminal_shows_tables_whole():
    solved, length = np.arange(1000) < 999, np.full(1000, 33)
    compared, layout = Optimality(999, 100.0, 0.9876, 0.1234), np.arange(1000) % 5
    scores = [
        Score.of("stsy", "{St, Sy}", solved, length, layout=layout),
        Score.of("pstsy", "{P, St, Sy}", solved, length, optimality=compared),
    ]
    console = Console(record=True, width=80)
    for table in (report.evaluation_table(scores, "x"), report.optimality_table(scores, "x")):
        console.print(table.to_rich())
    lines = [line.split() for line in console.export_text().splitlines()]
    assert ["{St,", "Sy}", "(stsy)", "1000", "99.9", "5", "of", "5", "–", "33.0"] in lines
    assert ["{P,", "St,", "Sy}", "(pstsy)", "1000", "99.9", "–", "99.4–100.0", "33.0"] in lines
    assert ["{P,", "St,", "Sy}", "(pstsy)", "100.0", "0.988", "0.123"] in lines


def test_refusals():
    config = Config(**TINY)
    with pytest.raises(ValueError, match=r"unknown task set 'q'; allowed: .*pstsy"):
        Evaluator.of_sets(config, ["q"], 2)
    with pytest.raises(ValueError, match="name at least one task set; allowed: base, p"):
        Evaluator.of_sets(config, [], 2)
    with pytest.raises(ValueError, match="must be an integer >= 1, got 0"):
        evaluation_tasks("p", 0)
