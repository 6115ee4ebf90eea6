"""The points of a grid, their settings, and the paper's protocols."""

import dataclasses

import pytest

from agents.config import Config
from agents.runs.folder import RunFolder
from agents.runs.run import Run, RunOptions
from agents.sweeps import records
from agents.sweeps.grids import GRIDS, Grid, Options
from helpers.refusal import assert_refused
from trap_tube_jax.imports import import_modules


def configs(*settings, grid=None, **options):
    return (grid or Grid()).configs(Options(settings=settings, **options))


def test_a_grid_holds_every_combination_by_name():
    found = configs("learning_rate=1e-3,3e-4", "curiosity=icm,none", "clip_eps=0.3")
    rates = ("1e-3", "3e-4")
    names = ("icm", "none")
    assert list(found) == [f"learning_rate={x},curiosity={y}" for x in rates for y in names]
    last = found["learning_rate=3e-4,curiosity=none"]
    assert (last.learning_rate, last.curiosity, last.clip_eps) == (3e-4, "none", 0.3)


@pytest.mark.parametrize(
    ("text", "name", "setting", "value"),
    [
        ("filters=[2,3],[4,5]", "filters=4x5", "filters", (4, 5)),
        ("align_to_food=true,false", "align_to_food=true", "align_to_food", True),
        ("max_steps=null,7", "max_steps=null", "max_steps", None),
        ("recurrent=True,False", "recurrent=False", "recurrent", False),
        ("max_steps=None,7", "max_steps=None", "max_steps", None),
    ],
)
def test_values_are_json_or_text(text, name, setting, value):
    assert getattr(configs(text, preset="paper")[name], setting) == value


def test_a_setting_may_have_no_effect_at_some_points():
    assert len(configs("curiosity=effects,none", "intrinsic_coef=0.5,1.0")) == 4
    found = configs("intrinsic_coef=0.5", grid=GRIDS["exp1"], preset="paper")
    assert {config.intrinsic_coef for config in found.values()} == {0.5}


def test_runs_are_ordered_by_seed_and_carry_their_point(tmp_path, fresh_task_sets):
    given = Options(("curiosity=none,icm",), ("agents.examples.near_food",), seeds=2, seed=3)
    given = dataclasses.replace(given, env="near-food", out=tmp_path)
    import_modules(given.imports)
    runs = Grid().make_runs("sweep", given, RunOptions())
    assert [str(path.relative_to(tmp_path)) for path in runs] == [
        f"sweep-fast-near-food/curiosity={name}-seed{seed}"
        for seed in (3, 4)
        for name in ("none", "icm")
    ]
    run = list(runs.values())[1]
    assert (run.algorithm, run.seed, run.imports) == ("curiosity=icm", 3, given.imports)
    assert run.config.env_id == "NearFood-v0"


def test_a_grid_of_sets_has_one_folder_in_any_order_and_for_any_choice(tmp_path):
    paths = set()
    for value, only in (("base,p", ()), ("p,base", ()), ("base,p,st", ("env_id=p",))):
        given = Options((f"env_id={value}",), only=only, out=tmp_path)
        paths |= set(Grid().make_runs("sweep", given, RunOptions()))
    folder = tmp_path / "sweep-fast-sets"
    assert paths == {folder / f"env_id={name}-seed0" for name in ("base", "p")}


@pytest.mark.parametrize(
    ("name", "short", "iterations"), [("exp1", "base", 250), ("exp2", "pstsy", 500)]
)
def test_grids_train_as_the_paper_says(name, short, iterations):
    grid = GRIDS[name]
    found = grid.configs(grid.options)
    assert {k: v.curiosity for k, v in found.items()} == {"ppo": "none", "ppo+icm": "icm"}
    for config in found.values():
        assert (config.env_id, config.iterations, config.eval_episodes) == (short, iterations, 128)
    assert (grid.options.preset, grid.options.seeds) == ("paper", 5)
    assert grid.run_options == RunOptions(evaluate_every=1, test_tasks=1000)


def test_a_named_grid_keeps_its_settings_unless_given():
    grid = GRIDS["curiosities"]
    for settings, iterations in ((("filters=[32,64]",), 312), (("iterations=20",), 20)):
        given = dataclasses.replace(grid.options, settings=settings, only=("ppo+effects",))
        run = next(iter(grid.make_runs("curiosities", given, grid.run_options).values()))
        assert (run.algorithm, run.config.curiosity) == ("ppo+effects", "effects")
        assert run.config.iterations == iterations
    assert (
        next(iter(grid.make_runs("curiosities", grid.options, grid.run_options))).parent.name
        == "curiosities"
    )
    other = dataclasses.replace(grid.options, preset="fast")
    assert (
        next(iter(grid.make_runs("curiosities", other, grid.run_options))).parent.name
        == "curiosities-fast-pstsy"
    )


def test_a_stored_run_with_other_settings_or_evaluations_is_refused(tmp_path):
    given = Options(settings=("clip_eps=0.3",), out=tmp_path)
    ((path, run),) = Grid().make_runs("sweep", given, RunOptions()).items()
    other = Run(dataclasses.replace(run.config, clip_eps=0.2), algorithm="fast")
    path.mkdir(parents=True)
    RunFolder(path).write_config(other)
    words = ["clip_eps=0.2, not 0.3", "another --name"]
    assert_refused(words, records.check, path.parent, {path: run}, RunOptions())
    RunFolder(path).write_config(run)
    longer = dataclasses.replace(run, config=dataclasses.replace(run.config, iterations=200))
    records.check(path.parent, {path: longer}, RunOptions())
    words = ["test_tasks=None, not 7", "python -m agents.evaluate"]
    assert_refused(words, records.check, path.parent, {path: run}, RunOptions(test_tasks=7))


def test_a_grid_is_not_put_into_a_run(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "config.json").touch()
    given = Options(name="x", out=tmp_path)
    assert_refused(["x is a run; give another"], Grid().make_runs, "sweep", given, RunOptions())


def test_the_arms_of_the_published_code_hold_the_papers_two():
    for number in ("1", "2"):
        paper, code = (GRIDS[name].points for name in (f"exp{number}", f"exp{number}-code"))
        assert paper.items() <= code.items()
    found = configs(grid=GRIDS["exp2-code"], preset="paper")
    assert found["ppo+bonus"].curiosity_coef == 0 < found["ppo+bonus"].intrinsic_coef
    assert not found["ppo+icm-blind"].previous_inputs


def test_a_grid_leaves_out_one_ingredient_of_best_at_a_time():
    grid = GRIDS["ingredients"]
    best, *others = grid.configs(grid.options).values()
    assert best == Config.preset("best", env_id="pstsy", **grid.settings)
    changed = [
        {name for name, value in config.to_dict().items() if value != best.to_dict()[name]}
        for config in others
    ]
    assert all(changed)
    assert sum(map(len, changed)) - len(set.union(*changed)) == 1, "curiosity alone changes twice"
