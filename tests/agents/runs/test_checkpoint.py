"""Checkpoints: whole or not there, whatever interrupts or damages them."""

import shutil

import jax
import numpy as np
import pytest

from agents.arrays import to_arrays
from agents.runs import checkpoint
from helpers.trees import assert_same


def example(offset):
    kernel = np.random.default_rng(0).normal(size=(2, 40, 3)).astype(np.float32) + offset
    return {"kernel": kernel, "key": jax.random.split(jax.random.key(7), 2), "none": np.zeros(0)}


def save(folder, iteration, offset):
    checkpoint.save(folder, iteration, example(offset), {"note": f"after {offset}"})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with checkpoints 1 to 4, of which two are kept."""
    monkeypatch.setattr(checkpoint, "KEPT", 2)
    for iteration in range(1, 5):
        save(tmp_path / "checkpoints", iteration, iteration)
    return tmp_path / "checkpoints"


def test_the_newest_checkpoints_are_kept_and_read_back(folder):
    assert checkpoint.iterations(folder) == [3, 4]
    for iteration, expected in ((None, 4), (3, 3), (4, 4)):
        arrays, record = checkpoint.load(folder, iteration)
        assert record == {"note": f"after {expected}", "iteration": expected}
        assert_same(arrays, to_arrays(example(expected)))
    with pytest.raises(ValueError, match=r"no checkpoint 7; allowed: 3, 4"):
        checkpoint.load(folder, 7)


def test_checkpoints_are_ordered_by_number(folder):
    for iteration in (9, 10):
        save(folder, iteration, iteration)
    assert checkpoint.iterations(folder) == [9, 10]
    assert checkpoint.load(folder)[1]["iteration"] == 10


def test_reading_creates_no_file(tmp_path):
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(ValueError, match=r"holds no checkpoint$"):
            checkpoint.load(folder)
    assert not list(tmp_path.iterdir())


def test_a_save_that_was_killed_is_passed_over_and_removed(folder):
    """Files and folders of others stay, such as those of Jupyter or NFS."""
    shutil.copy(folder / "4.safetensors", folder / ".5.safetensors.77")
    (folder / ".ipynb_checkpoints").mkdir()
    assert checkpoint.iterations(folder) == [3, 4]
    save(folder, 5, 5)
    names = [".ipynb_checkpoints", "4.safetensors", "5.safetensors"]
    assert sorted(path.name for path in folder.iterdir()) == names


def test_a_save_that_fails_is_an_error_of_the_file_system(folder, monkeypatch):
    def fail(*args):
        raise OSError("No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(OSError, match=r"No space left"):
        save(folder, 5, 5)
    assert checkpoint.iterations(folder) == [3, 4]
    with pytest.raises(FileNotFoundError):
        save(folder / "vanished" / "checkpoints", 5, 5)


def test_a_checkpoint_cut_short_is_refused(folder):
    path = folder / "4.safetensors"
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        path.write_bytes(content[:place])
        with pytest.raises(ValueError, match=r"4.safetensors cannot be read: .*delete it to use"):
            checkpoint.load(folder)
