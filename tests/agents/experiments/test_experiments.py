"""What is run and what is refused: protocols, algorithms, command lines."""

import dataclasses
import json
import shlex
from types import SimpleNamespace
from typing import Any

import pytest

from agents.config import PRESETS, Config
from agents.experiments import __main__ as experiments
from agents.experiments import records, reporting, training
from agents.experiments.protocol import PROTOCOLS, QUICK, Protocol, algorithms, parse_setting
from agents.experiments.tables import algorithm_label
from agents.parallel.sharding import Placement
from agents.runs.folder import Run, RunFolder, read_json, write_json
from agents.runs.metrics import MetricsLog
from refusal import refused
from trap_tube_jax.scoring.tasks import ALL_SETS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algorithms ppo icm", f"unknown algorithm 'icm'; allowed: {', '.join(algorithms())}"),
        ("--preset slow", "unknown preset 'slow'; allowed: paper, fast"),
        ("--seeds 0", "seeds must be >= 1, got 0"),
        ("--reported 0", "reported must be >= 1, got 0"),
        ("--evaluate-every 0", "evaluate_every must be >= 1, got 0"),
        ("--checkpoint-every 0", "checkpoint_every must be >= 1, got 0"),
        ("--iterations 0", "iterations must lie in [1, inf], got 0"),
        ("--settings hiden=4", "unknown setting 'hiden'; did you mean 'hidden'?"),
        ("--settings iterations=9", "iterations is none of --settings; give --iterations"),
        ("--settings eval_episodes=9", "eval_episodes is none of --settings; give --tasks"),
        ("--algorithms ppo,iterations=9", "iterations is none of --settings; give --iterations"),
        ("--algorithms ppo,hidden", "settings are given as NAME=VALUE, got 'hidden'"),
        ("--algorithms ppo,hiden=4", "unknown setting 'hiden'; did you mean 'hidden'?"),
        ("--algorithms ppo,env_id=P", "env_id is none of --settings; give --train-set"),
        ("--algorithms preset preset,max_steps=25", "max_steps is the same for all algorithms"),
        ("--algorithms preset,num_features=4", "give it by --settings, not in 'preset,num_feat"),
        ("--settings hidden", "settings are given as NAME=VALUE, got 'hidden'"),
        ("--name a/b", "name must be the name of a folder, without a path, got 'a/b'"),
        ("--report-only", "exp1-paper holds no experiment"),
        ("--algorithms ppo ppo+counts --train-set p", "'counts' needs tasks that return"),
    ],
)
def test_impossible_experiments_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(
        capsys, experiments.main, "exp1", *arguments.split(), "--out", tmp_path
    )
    assert not list(tmp_path.iterdir())


def test_a_dirty_tree_is_refused_before_training(capsys, tmp_path, monkeypatch):
    arguments = ["exp1", "--out", tmp_path, "--record", tmp_path / "x.json"]
    monkeypatch.setattr(records, "machine", lambda: {"commit": "abc-dirty"})
    assert "this one of abc-dirty" in refused(capsys, experiments.main, *arguments)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(records, "machine", lambda: {"commit": "abc"})
    folder = RunFolder.create(tmp_path / "exp1-paper" / "ppo-seed0", Run(Config()))
    write_json(folder.machines, [{"commit": "def-dirty"}])
    MetricsLog(folder.metrics).append([{"seed": 0, "iteration": 1}])
    assert "this one of def-dirty" in refused(capsys, experiments.main, *arguments)
    assert not (tmp_path / "exp1-paper" / "experiment.json").exists()


def test_protocols_are_the_papers():
    assert (PROTOCOLS["exp1"].iterations, PROTOCOLS["exp2"].iterations) == (250, 500)
    for protocol in PROTOCOLS.values():
        assert (protocol.preset, protocol.seeds, protocol.tasks) == ("paper", 5, 128)
        assert protocol.algorithms == ("ppo", "ppo+icm")
        config = protocol.config("ppo+icm")
        assert (config.curiosity, config.episodes_per_iteration, config.stop_when_solved) == (
            "icm",
            1024,
            0,
        )
        assert protocol.config("ppo").curiosity == "none"
        assert (protocol.selection, protocol.num_reported) == ("validation", 1000)
    fast = QUICK["exp1"].config("preset")
    assert (fast.curiosity, fast.eval_episodes) == ("effects", 16)


@pytest.mark.parametrize("experiment", QUICK)
def test_the_quick_protocol_can_be_trained(tmp_path, experiment):
    protocol = training.open_experiment(
        tmp_path / "x", experiment, QUICK[experiment], {}, create=True
    )
    assert protocol == QUICK[experiment]


def test_stored_protocols_are_whole():
    """An old one did not say on which tasks its evaluations were chosen."""
    values = json.loads(json.dumps(dataclasses.asdict(PROTOCOLS["exp1"])))
    assert Protocol.from_dict(values) == PROTOCOLS["exp1"]
    with pytest.raises(ValueError, match="eval_episodes is none of --settings; give --tasks"):
        Protocol.from_dict({**values, "settings": {"hidden": 4, "eval_episodes": 9}})
    del values["selection"]
    with pytest.raises(ValueError, match="a protocol lacks selection"):
        Protocol.from_dict(values)


@pytest.mark.parametrize("preset", PRESETS)
def test_any_sets_are_trained_and_evaluated_on(preset):
    sets = {"train_set": "SymbolicTrapTube-v0", "sets": ("base", "psy")}
    options = experiments.Options("exp1", preset=preset, **sets)
    assert options.root.name == f"exp1-{preset}-sy"
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


@pytest.mark.parametrize("preset", PRESETS)
def test_ppo_is_ppo_alone_in_every_preset(preset):
    protocol = Protocol(preset=preset)
    whole = protocol.config("preset")
    for name in ("ppo", "ppo+icm", "ppo+counts"):
        config = protocol.config(name)
        assert config.curiosity == (name.partition("+")[2] or "none")
        assert config.learning_rate == whole.learning_rate


def test_an_algorithm_may_change_settings():
    protocol = Protocol(preset="best", train_set="pstsy", settings={"hidden": 32})
    whole = protocol.config("preset")
    changed = protocol.config("preset,encoder=paper,filters=[8,16],hidden=64")
    fields = {"encoder": "paper", "filters": (8, 16), "hidden": 64}
    assert changed == dataclasses.replace(whole, **fields)
    plain = protocol.config("ppo,recurrent=false")
    assert (plain.curiosity, plain.recurrent, plain.hidden) == ("none", False, 32)
    names = ("preset", "preset,filters=[8,16]")
    command = dataclasses.replace(protocol, algorithms=names).command("exp2", names)
    assert "--algorithms preset 'preset,filters=[8,16]'" in command
    record = {"protocol": dataclasses.asdict(protocol)}
    assert algorithm_label(record, {"name": "preset,hidden=64"}) == "best, hidden=64"
    assert algorithm_label(record, {"name": "ppo"}) == "PPO"


def test_a_command_can_be_pasted_into_a_shell():
    settings = {"encoder": "my encoder's", "filters": [8, 16], "recurrent": False}
    words = shlex.split(Protocol(settings=settings).command("exp1", ["ppo"]))
    given = words[words.index("--settings") + 1 :]
    assert dict(map(parse_setting, given)) == settings


def test_a_command_says_on_how_many_devices_its_runs_were_trained(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "machine", lambda commit: {"devices": 8, "commit": commit})
    folder = RunFolder.create(tmp_path / "x", Run(Config()))
    for devices, used in ((1, [1]), (2, [1, 2])):
        mesh: Any = SimpleNamespace(size=devices)
        training.note_machine(folder, Placement(mesh if devices > 1 else None), "abc")
        assert [each["devices"] for each in read_json(folder.machines)] == used
    for machines, devices in (([1, 1], 1), ([1, 2], None), ([None], None), ([], None)):
        assert reporting._devices([{"devices": each} for each in machines]) == devices
    assert reporting._devices([{}]) is None
    protocol = PROTOCOLS["exp1"]
    assert protocol.command("exp1", ["ppo"], 2).endswith(" --algorithms ppo --devices 2")
    assert "--devices" not in protocol.command("exp1", ["ppo"])
