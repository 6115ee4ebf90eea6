"""The task sets by name."""

import dataclasses
import pickle

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from trap_tube_jax import play
from trap_tube_jax.state import take

# environment.md, "Task sets".
SPECIFIED = [
    ("TrapTube-v0", "base", "base", ()),
    ("PerceptualTrapTube-v0", "p", "{P}", (tt.perceptual,)),
    ("StructuralTrapTube-v0", "st", "{St}", (tt.structural,)),
    ("SymbolicTrapTube-v0", "sy", "{Sy}", (tt.symbolic,)),
    ("PerceptualStructuralTrapTube-v0", "pst", "{P, St}", (tt.perceptual, tt.structural)),
    ("PerceptualSymbolicTrapTube-v0", "psy", "{P, Sy}", (tt.perceptual, tt.symbolic)),
    ("StructuralSymbolicTrapTube-v0", "stsy", "{St, Sy}", (tt.structural, tt.symbolic)),
    (
        "PerceptualStructuralSymbolicTrapTube-v0",
        "pstsy",
        "{P, St, Sy}",
        (tt.perceptual, tt.structural, tt.symbolic),
    ),
]


def test_the_papers_sets_are_found_by_id_short_name_and_label():
    sets = [(entry.id, entry.short, entry.label, entry.transfers) for entry in tt.PAPER_TASK_SETS]
    assert sets == SPECIFIED
    assert tt.registered_ids()[:8] == tuple(entry[0] for entry in SPECIFIED)

    for name, short, label, transfers in SPECIFIED:
        for env in map(tt.make, (name, short, label)):
            assert (env.transfers, env.max_steps, env.num_features) == (transfers, 50, 3)


def test_register_adds_a_set(fresh_task_sets):
    def to_the_top(key, state):
        del key
        return state.replace(agent=state.agent.at[0].set(0))

    transfers = (tt.structural, to_the_top)
    entry = tt.register("Top-v0", iter(transfers))
    assert tt.registered_ids()[-1] == "Top-v0"
    assert (entry.short, entry.label) == ("Top-v0", "Top-v0")
    assert tt.task_set("Top-v0") is entry
    assert tt.make("Top-v0").transfers == entry.transfers == transfers


def test_base_state_and_step_limit_come_from_the_set_unless_given(fresh_task_sets):
    base = tt.base_state(5).replace(agent=np.array((0, 0), np.int32))
    entry = tt.register("Own-v0", (), short="own", base=base, max_steps=20)
    assert (entry.base, entry.max_steps, entry.label) == (base, 20, "own")
    for env, limit in (
        (tt.make("own"), 20),
        (tt.make("own", num_features=5, max_steps=30), 30),
        (tt.make("p", base=base, num_features=5), 50),
        (tt.make("p", base=base, max_steps=7), 7),
    ):
        assert (env.base, env.max_steps, env.num_features) == (base, limit, 5)
    assert tt.make("own", base=tt.base_state()).num_features == 3
    assert tt.make("p", num_features=2).num_features == 2
    assert_refused(["num_features=3", "5 features"], tt.make, "own", num_features=3)
    assert len({entry, *tt.PAPER_TASK_SETS}) == 9


@pytest.mark.parametrize("options", [{}, {"base": tt.base_state()}, {"max_steps": 20}])
def test_no_two_sets_have_one_label(fresh_task_sets, options):
    tt.register("Own-v0", (tt.structural,), short="own", **options)
    labels = [tt.task_set(name).label for name in tt.registered_ids()]
    assert len(set(labels)) == len(labels)
    assert labels[-1] == "own"


def test_a_custom_set_may_be_registered_again(fresh_task_sets):
    before = tt.register("Own-v0", (), short="own", max_steps=20)
    assert tt.register("Own-v0", (), short="own", max_steps=20) == before
    tt.register("Own-v0", (tt.structural,), short="own", max_steps=30)
    assert tt.task_set("own") != before
    for env in (tt.make("own"), play.new_game("own", 0).env):
        assert (env.transfers, env.max_steps) == ((tt.structural,), 30)
    assert tt.registered_ids().count("Own-v0") == 1
    assert_refused(["'own' is taken"], tt.register, "Other-v0", (), short="own")
    assert tt.make("own").max_steps == 30


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("TrapTube-v1", "TrapTube-v0"),
        ("traptube-v0", "TrapTube-v0"),
        ("P", "p"),
        ("psty", "pstsy"),
        ("{P,St}", "{P, St}"),
        ("two_traps", "two-traps"),
        ("mine", None),
        ("", None),
        (3, None),
        (None, None),
        (["p"], None),
    ],
)
def test_make_refuses_an_unknown_name_and_offers_the_nearest(name, meant):
    shorts = ", ".join(entry[1] for entry in SPECIFIED)
    assert_refused([f"unknown task set {name!r}", f"allowed: {shorts}, "], tt.make, name)
    with pytest.raises(ValueError, match="unknown") as error:
        tt.make(name)
    assert (f"did you mean {meant!r}" in str(error.value)) == (meant is not None)
    assert ("did you mean" in str(error.value)) == (meant is not None)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"num_features": 2.5}, ["num_features", ">= 1", "2.5"]),
        ({"num_features": 10**9}, ["num_features", "<= 1024", "1000000000"]),
        ({"num_features": 4, "base": tt.base_state(5)}, ["num_features=4", "5 features"]),
        ({"max_steps": 0}, ["max_steps", ">= 1", "0"]),  # as `Environment` does
    ],
)
def test_impossible_environments_are_refused(options, words):
    assert_refused(words, tt.make, "TrapTube-v0", **options)


@dataclasses.dataclass
class Unhashable:
    by: int

    def __call__(self, key, state):
        return state.replace(agent=state.agent - self.by)


SOLVED = tt.base_state().replace(terminated=np.True_)
BAD_SETS = [
    ("TrapTube-v0", (), {}, ["'TrapTube-v0' is taken", "pstsy"]),
    ("TwoTrapsControl-v0", (), {}, ["'TwoTrapsControl-v0' is taken"]),
    ("Mine-v0", (), {"short": "psy"}, ["'psy' is taken", "TrapTube-v0"]),
    ("", (), {}, ["letters, digits", "''"]),
    (7, (), {}, ["letters, digits", "7"]),
    ("mine/Mine-v0", (), {}, ["letters, digits", "'mine/Mine-v0'"]),
    ("Mine-v0", (), {"short": "my set"}, ["letters, digits", "'my set'"]),
    ("Mine-v0", (Unhashable(3),), {}, ["hashable", "a frozen dataclass", "Unhashable(by=3)"]),
    ("Mine-v0", (), {"base": SOLVED}, ["terminated", "unfinished"]),
    ("Mine-v0", (), {"max_steps": None}, ["max_steps", "integer >= 1", "None"]),
]


@pytest.mark.parametrize(("name", "transfers", "options", "words"), BAD_SETS)
def test_register_refuses(fresh_task_sets, name, transfers, options, words):
    assert_refused(words, tt.register, name, transfers, **options)
    assert "Mine-v0" not in tt.registered_ids()


def test_a_mixture_draws_a_set_as_often_as_it_is_named():
    env = tt.make("base+{P}+p+base+st+base")
    assert env.max_steps == 50
    keys = jax.random.split(jax.random.key(0), 1200)
    states, _ = jax.jit(jax.vmap(env.reset))(keys)
    base = tt.base_state()
    is_recolored = (np.asarray(states.palette) != np.asarray(base.palette)).any(axis=(1, 2))
    is_base_board = (np.asarray(states.board) == np.asarray(base.board)).all(axis=(1, 2))
    counts = np.array([is_recolored.sum(), (is_base_board & ~is_recolored).sum()])
    np.testing.assert_allclose(counts / 1200, [1 / 6, 3 / 6], atol=0.05)
    for index in range(20):
        tt.validate(take(states, index))


def test_a_mixture_is_a_task_set_with_id_short_name_and_label():
    entry = tt.task_set("p + {P, St, Sy}")
    assert (entry.short, entry.label) == ("p+pstsy", "{P} + {P, St, Sy}")
    assert tt.task_set(entry.id) == tt.task_set(entry.short) == tt.task_set(entry.label) == entry
    assert hash(tt.make("p+pstsy")) == hash(pickle.loads(pickle.dumps(tt.make("p+pstsy"))))
    assert len(tt.evaluation_tasks("p+pstsy", 3).time) == 3


def test_a_mixture_refuses_sets_that_do_not_mix(fresh_task_sets):
    tt.register("Short-v0", (), max_steps=20)
    tt.register("Own-v0", (), base=tt.base_state())
    assert_refused(["one step limit; p has 50 steps, Short-v0 20"], tt.make, "p+Short-v0")
    assert_refused(["base task; Own-v0 has a base state of its own"], tt.make, "Own-v0+p")
    assert_refused(["unknown task set 'pts' (did you mean"], tt.make, "p+pts")
    assert_refused(["joined by '+', got 'p+'"], tt.make, "p+")
