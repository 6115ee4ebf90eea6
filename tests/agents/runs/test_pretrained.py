"""Parameters as files: written, shipped, evaluated, and what is refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import evaluate, pretrained
from agents.acting.policy import Policy
from agents.config import Config
from agents.networks.agent import Agent
from agents.pretrained.__main__ import main
from agents.runs.checkpoint import Checkpoints
from agents.runs.folder import Run, RunFolder
from agents.runs.loading import load_policies
from refusal import refused

CONFIG = Config(
    env_id="SymbolicTrapTube-v0",
    max_steps=6,
    filters=(2, 2),
    hidden=4,
    embedding=2,
    eval_episodes=2,
    curiosity="none",
)
SEEDS = (3, 4)


def random_params(seed):
    shapes = jax.eval_shape(Agent(CONFIG).init, jax.random.key(0))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), shapes)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.fixture(scope="module")
def run_path(tmp_path_factory):
    """A run of two seeds with two checkpoints, and the best parameters of its first seed."""
    path = tmp_path_factory.mktemp("runs") / "mine"
    folder = RunFolder.create(path, Run(CONFIG, seed=SEEDS[0], seeds=2))
    both = jax.tree.map(lambda *x: jnp.stack(x), *map(random_params, SEEDS))
    with Checkpoints(folder.checkpoints, keep=2) as checkpoints:
        for iteration in (5, 6):
            params = jax.tree.map(lambda x, n=iteration: x * n, both)
            state = {"params": params, "iteration": jnp.full(2, iteration)}
            checkpoints.save(iteration, state, {})
    pretrained.save(folder.best(3, 4), Policy("any", CONFIG, random_params(9), 4))
    return path


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A folder in the place of the package's own."""
    monkeypatch.setattr(pretrained, "_folder", lambda: tmp_path)
    return tmp_path


def export(out, run_path, *arguments):
    main(["export", str(run_path), "--name", "x", "--out", str(out), *map(str, arguments)])
    return pretrained.load(out / "x.npz")


@pytest.mark.parametrize(
    ("arguments", "iteration", "seed", "factor"),
    [
        ([], 6, 3, 6),
        (["--seed", 4], 6, 4, 6),
        (["--seed", 4, "--iteration", 5], 5, 4, 5),
        (["--best"], 4, 9, 1),
    ],
)
def test_a_run_is_exported(run_path, tmp_path, arguments, iteration, seed, factor):
    policy = export(tmp_path, run_path, *arguments)
    assert (policy.name, policy.config, policy.iteration) == ("x", CONFIG, iteration)
    assert_equal(policy.params, jax.tree.map(lambda x: x * factor, random_params(seed)))


def test_half_precision_is_half_the_size_and_close(run_path, tmp_path):
    whole = export(tmp_path, run_path)
    size = (tmp_path / "x.npz").stat().st_size
    half = export(tmp_path, run_path, "--half", "--force")
    assert (tmp_path / "x.npz").stat().st_size < size
    for a, b in zip(jax.tree.leaves(half.params), jax.tree.leaves(whole.params), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_shipped_parameters_are_evaluated(run_path, shipped, capsys):
    export(shipped, run_path)
    results = shipped / "results.json"
    common = ["--sets", "base", "--json", str(results)]
    evaluate.main(["--pretrained", "x", *common])
    assert "Greedy evaluation: pretrained, x, iteration 6" in capsys.readouterr().out
    (policy,) = json.loads(results.read_text())
    assert [(score["set"], score["tasks"]) for score in policy["sets"]] == [("base", 1)]
    assert pretrained.names() == ("x",)
    main(["list"])
    assert "x: SymbolicTrapTube-v0, iteration 6" in capsys.readouterr().out


def test_every_shipped_file_can_be_loaded():
    total = 0
    trained_on = {"base": "base", "paper": "base", "pstsy": "pstsy", "taught": "pstsy"}
    assert pretrained.names() == tuple(trained_on)
    for name, env in trained_on.items():
        policy = pretrained.load_shipped(name)
        assert policy.iteration > 0
        assert tt.task_set(policy.config.env_id).short == env
        total += len((pretrained._folder() / f"{name}.npz").read_bytes())
    assert total < 4_000_000


def test_impossible_exports_are_refused(run_path, tmp_path, capsys):
    for arguments, message in (
        (["--seed", 5], "mine has no seed 5; allowed: 3, 4"),
        (["--iteration", 7], "holds no checkpoint 7; allowed: 5, 6"),
        (["--best", "--seed", 4], "mine keeps no best parameters of seed 4"),
        (["--best", "--iteration", 5], "--best and --iteration name different parameters"),
    ):
        given = ["export", run_path, "--name", "x", "--out", tmp_path, *arguments]
        assert message in refused(capsys, main, *given)
    for name in ("a/x", "..", ""):
        message = refused(capsys, main, "export", run_path, "--name", name, "--out", tmp_path)
        assert f"name must be the name of a file, without a path, got {name!r}" in message
    assert "holds no run" in refused(capsys, main, "export", tmp_path / "no", "--name", "x")
    assert not list(tmp_path.iterdir())


def test_parameters_are_replaced_on_demand_only(tmp_path, capsys):
    (tmp_path / "x.npz").touch()
    arguments = ["export", tmp_path / "no", "--name", "x", "--out", tmp_path]
    assert "x.npz exists; give --force to replace it" in refused(capsys, main, *arguments)
    assert "holds no run" in refused(capsys, main, *arguments, "--force")


def test_a_folder_that_is_no_run_does_not_hide_shipped_parameters(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "base").mkdir()
    monkeypatch.setattr(pretrained, "load_shipped", lambda name: f"shipped {name}")
    assert load_policies("base") == ["shipped base"]
    with pytest.raises(ValueError, match=r"holds no run; .*shipped parameters: base"):
        load_policies("./base/.")


def test_unknown_parameters_are_refused(run_path, shipped, capsys):
    assert "unknown parameters 'q'; allowed: none" in refused(
        capsys, evaluate.main, "--pretrained", "q"
    )
    export(shipped, run_path)
    message = refused(capsys, evaluate.main, "--pretrained", "q")
    assert "unknown parameters 'q'; allowed: x" in message
    for arguments in ([], [run_path, "--pretrained", "x"]):
        message = refused(capsys, evaluate.main, *arguments)
        assert "give a run's folder or --pretrained NAME, one of them" in message
    message = refused(capsys, evaluate.main, "--pretrained", "x", "--iteration", 5)
    assert "--iteration names a checkpoint of a run" in message


def rewritten(path, **changes):
    """The file with some of its entries replaced; the header as a dictionary."""
    with np.load(path) as archive:
        entries = dict(archive)
    header = {**json.loads(str(entries["header"])), **changes.pop("header", {})}
    np.savez(path, **{**entries, "header": np.array(json.dumps(header)), **changes})


def test_a_flipped_bit_is_refused_unless_the_numbers_are_still_the_same(run_path, tmp_path):
    """An archive has some bytes of no meaning, such as the time of writing."""
    path = tmp_path / "x.npz"
    export(tmp_path, run_path)
    good, params = path.read_bytes(), pretrained.load(path).params
    places = range(0, len(good), len(good) // 20)
    refused = 0
    for place in places:
        path.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
        try:
            found = pretrained.load(path).params
        except ValueError as error:
            assert "x.npz" in str(error)  # noqa: PT017
            refused += 1
        else:
            jax.tree.map(np.testing.assert_array_equal, found, params)
    assert refused > len(places) / 2


def test_a_directory_at_a_wrong_place_is_refused(run_path, tmp_path):
    path = tmp_path / "x.npz"
    export(tmp_path, run_path)
    good = bytearray(path.read_bytes())
    offset = good.rfind(b"PK\x05\x06") + 16  # in the record at the archive's end
    good[offset + 2] ^= 1  # 65,536 bytes on
    path.write_bytes(good)
    with pytest.raises(ValueError, match=r"x\.npz is damaged"):
        pretrained.load(path)


def test_files_that_hold_no_parameters_are_refused(run_path, tmp_path):
    path = tmp_path / "x.npz"
    export(tmp_path, run_path)
    good = path.read_bytes()

    def refuses(words):
        with pytest.raises(ValueError, match=words):
            pretrained.load(path)
        path.write_bytes(good)

    for size in (0, 1, 100, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:size])
        refuses("x.npz is .*not a file of parameters")
    path.write_text("something else")
    refuses("x.npz is not a file of parameters")
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    refuses("x.npz is not a file of parameters")
    np.savez(path, a=np.zeros(3))
    refuses("x.npz is not a file of parameters")
    rewritten(path, **{"params": np.zeros(3)})
    refuses("does not hold the numbers that were saved")
    rewritten(path, header={"format": "trap-tube-jax parameters 99"})
    refuses("x.npz is not a file of parameters")
    rewritten(path, header={"config": {"colour": 1}})
    refuses("does not fit this version: unknown setting 'colour'")
    rewritten(path, header={"config": {**CONFIG.to_dict(), "hidden": 5}})
    refuses("does not fit this version: ")
