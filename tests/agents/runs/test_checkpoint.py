"""Checkpoints: whole or not there, whatever interrupts their writing."""

import shutil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.runs.checkpoint import (
    CheckpointError,
    Checkpoints,
    digest,
    from_arrays,
    to_arrays,
)


class Nested(NamedTuple):
    params: dict[str, Any]
    opt_state: tuple[Any, ...]
    key: jax.Array
    iteration: jax.Array


def example(offset=0.0):
    """A pytree of every kind of leaf that training has, two seeds of it."""
    kernel = np.random.default_rng(0).normal(size=(2, 40, 3)).astype(np.float32) + offset
    return Nested(
        params={"encoder": {"params": {"kernel": jnp.asarray(kernel)}}, "bias": jnp.zeros((2, 1))},
        opt_state=((), Nested({}, (), jax.random.split(jax.random.key(1), 2), jnp.arange(2))),
        key=jax.random.split(jax.random.key(7), 2),
        iteration=jnp.array([3, 4], jnp.int32),
    )


def bits(x):
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x).tobytes()


def assert_same_bits(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert bits(x) == bits(y)


def refusal(checkpoints, expected):
    """What is said of a checkpoint; nothing if it still holds the expected numbers."""
    try:
        arrays, _ = checkpoints.load(4)
    except CheckpointError as error:
        return str(error)
    assert digest(arrays) == expected
    return ""


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with checkpoints 1 to 4, of which two were to be kept. Not to be changed."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    with Checkpoints(folder, keep=2) as checkpoints:
        for iteration in range(1, 5):
            checkpoints.save(iteration, example(iteration), {"note": f"after {iteration}"})
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "checkpoints")


def test_state_comes_back_bit_for_bit(saved):
    with Checkpoints(saved) as checkpoints:
        state, record = checkpoints.restore(jax.eval_shape(example))
    assert_same_bits(state, example(4))
    assert (record["note"], record["iteration"]) == ("after 4", 4)


def test_the_newest_are_kept(saved):
    with Checkpoints(saved) as checkpoints:
        assert checkpoints.iterations == [3, 4]
        arrays, record = checkpoints.load(3)
    assert record["note"] == "after 3"
    assert digest(arrays) == digest(to_arrays(example(3)))


def test_a_taken_name_is_not_written_again(folder):
    with Checkpoints(folder, keep=2) as checkpoints:
        checkpoints.save(4, example(99), {"note": "other"})
        assert checkpoints.load()[1]["note"] == "after 4"


def test_saved_arrays_do_not_share_memory_with_what_is_donated():
    state = jnp.zeros(1000)
    arrays = to_arrays({"x": state})
    jax.jit(lambda x: x + 1, donate_argnums=0)(state).block_until_ready()
    np.testing.assert_array_equal(arrays["x"], np.zeros(1000))
    assert arrays["x"].base is None


def test_reading_makes_nothing(tmp_path):
    with pytest.raises(CheckpointError, match=r"none holds no checkpoint$"):
        Checkpoints(tmp_path / "none")
    assert not list(tmp_path.iterdir())
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(CheckpointError, match=r"checkpoint$"):
        checkpoints.load()
    assert not list(tmp_path.iterdir())


def test_unknown_iteration_is_refused(saved):
    with (
        Checkpoints(saved) as checkpoints,
        pytest.raises(CheckpointError, match=r"no checkpoint 7; allowed: 3, 4"),
    ):
        checkpoints.load(7)


def test_a_save_that_was_killed_is_passed_over_and_removed(folder):
    draft = folder / "5.orbax-checkpoint-tmp"
    shutil.copytree(folder / "4", draft)
    with Checkpoints(folder) as checkpoints:
        assert checkpoints.iterations == [3, 4]
    with Checkpoints(folder, keep=2) as checkpoints:
        assert checkpoints.load()[1]["iteration"] == 4
        checkpoints.save(5, example(5), {"note": "after 5"})
        assert checkpoints.iterations == [4, 5]
    assert not draft.exists()


# Orbax, where it fails, leaves work to an event loop that it has closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("damage", ["truncate", "empty", "remove", "flip"])
def test_damage_to_any_file_is_refused_or_without_effect(saved, folder, damage):
    """No file of a checkpoint can be damaged so that other numbers are read."""
    expected = digest(to_arrays(example(4)))
    num_refused = 0
    for original in sorted(path for path in (saved / "4").rglob("*") if path.is_file()):
        path = folder / original.relative_to(saved)
        content = bytearray(original.read_bytes())
        middle = len(content) // 2
        if damage == "remove":
            path.unlink()
        elif damage == "flip":
            content[middle : middle + 1] = bytes(255 - x for x in content[middle : middle + 1])
            path.write_bytes(content)
        else:
            path.write_bytes(content[:middle] if damage == "truncate" else b"")
        with Checkpoints(folder) as checkpoints:
            message = refusal(checkpoints, expected)
        if message:
            num_refused += 1
            assert str(folder / "4") in message
            assert "delete that folder to use checkpoint 3 instead" in message
        path.write_bytes(original.read_bytes())
    assert num_refused >= 3


def test_a_foreign_checkpoint_is_refused(tmp_path):
    (tmp_path / "12").mkdir()
    (tmp_path / "12" / "model.bin").write_bytes(b"something else")
    with (
        Checkpoints(tmp_path) as checkpoints,
        pytest.raises(CheckpointError, match=r"12 cannot be read .*: delete that folder to begin"),
    ):
        checkpoints.load()


@pytest.mark.parametrize(
    ("template", "problem"),
    [
        (example()._replace(iteration=jnp.zeros(2)), r"iteration is int32\[2\], not float32\[2\]"),
        (example()._replace(iteration=jnp.zeros(3, int)), r"iteration is int32\[2\], not int32"),
        (example()._replace(key=jax.random.key(0)), r"key is uint32\[2, 2\], not PRNG keys"),
        (example()._replace(params={}), r"params/\S+ is not expected"),
        (example()._replace(opt_state=(jnp.zeros(1),)), r"opt_state/\S+ is (missing|not expected)"),
    ],
)
def test_a_checkpoint_of_other_settings_is_refused(saved, template, problem):
    with (
        Checkpoints(saved) as checkpoints,
        pytest.raises(CheckpointError, match=rf"4 does not fit .*{problem}"),
    ):
        checkpoints.restore(template)


def test_arrays_and_trees_are_inverse():
    assert_same_bits(from_arrays(to_arrays(example()), example()), example())


def test_keep_must_be_positive(tmp_path):
    with pytest.raises(ValueError, match="keep must be >= 1, got 0"):
        Checkpoints(tmp_path, keep=0)
