"""Checkpoints: whole or not there, whatever interrupts or damages them."""

import shutil

import jax
import numpy as np
import pytest

from agents.arrays import to_arrays
from agents.runs import checkpoint
from agents.runs.checkpoint import digest


def example(offset):
    kernel = np.random.default_rng(0).normal(size=(2, 40, 3)).astype(np.float32) + offset
    return {"kernel": kernel, "key": jax.random.split(jax.random.key(7), 2)}


def save(folder, iteration, offset):
    checkpoint.save(folder, iteration, example(offset), {"note": f"after {offset}"}, keep=2)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with checkpoints 1 to 4, of which two are kept. Not to be changed."""
    folder = tmp_path_factory.mktemp("run") / "checkpoints"
    for iteration in range(1, 5):
        save(folder, iteration, iteration)
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "checkpoints")


def test_the_newest_are_kept_and_come_back(saved):
    assert checkpoint.iterations(saved) == [3, 4]
    for iteration, expected in ((None, 4), (3, 3), (4, 4)):
        arrays, record = checkpoint.load(saved, iteration)
        assert (record["note"], record["iteration"]) == (f"after {expected}", expected)
        assert digest(arrays) == digest(to_arrays(example(expected)))
    with pytest.raises(ValueError, match=r"no checkpoint 7; allowed: 3, 4"):
        checkpoint.load(saved, 7)


def test_a_taken_name_is_not_written_again(folder):
    save(folder, 4, 99)
    assert checkpoint.load(folder)[1]["note"] == "after 4"


def test_reading_makes_nothing(tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(ValueError, match=r"holds no checkpoint$"):
            checkpoint.load(folder)
    assert not list(tmp_path.iterdir())


def test_a_save_that_was_killed_is_passed_over_and_removed(folder):
    draft = folder / "5.orbax-checkpoint-tmp"
    shutil.copytree(folder / "4", draft)
    assert checkpoint.iterations(folder) == [3, 4]
    save(folder, 5, 5)
    assert checkpoint.iterations(folder) == [4, 5]
    assert not draft.exists()


def test_a_reader_goes_on_with_the_newest_where_the_writer_deletes(folder, monkeypatch):
    """Between the reader's listing and its reading."""
    listed = iter([[3, 4]])
    list_now = checkpoint.iterations
    monkeypatch.setattr(checkpoint, "iterations", lambda path: next(listed, list_now(path)))
    shutil.copytree(folder / "4", folder / "5")
    shutil.rmtree(folder / "4")
    assert checkpoint.load(folder)[1]["note"] == "after 4"


def test_a_save_that_fails_is_an_error_of_the_file_system(folder, monkeypatch):
    def fail(*args, **kwargs):
        raise ValueError("NOT_ENOUGH_SPACE: disk full\nmore")

    monkeypatch.setattr(checkpoint.ocp.CheckpointManager, "save", fail)
    with pytest.raises(OSError, match=r"cannot write checkpoint 5: .*disk full$"):
        save(folder, 5, 5)
    assert checkpoint.iterations(folder) == [3, 4]
    with pytest.raises(FileNotFoundError):
        save(folder / "vanished" / "checkpoints", 5, 5)


# Orbax, where it fails, leaves work to an event loop that it has closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("damage", ["truncate", "remove", "flip"])
def test_damage_to_any_file_is_refused_or_without_effect(saved, folder, damage):
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
            path.write_bytes(content[:middle])
        try:
            assert digest(checkpoint.load(folder, 4)[0]) == expected
        except ValueError as error:
            num_refused += 1
            assert f"{folder / '4'} is damaged" in str(error)  # noqa: PT017
            assert "delete it to use checkpoint 3" in str(error)  # noqa: PT017
        path.write_bytes(original.read_bytes())
    assert num_refused >= 3
