"""Files of policies: whole, of this version and finite, or refused by name."""

import json

import numpy as np
import pytest
import safetensors.numpy

from agents.acting.policy_files import load_policy, save_policy
from agents.arrays import to_arrays
from easy import assert_same, enable_x64
from tiny_policy import CONFIG, random_policy

POLICY = random_policy()
ARRAYS = to_arrays(POLICY.params)


def test_a_stored_policy_is_the_same(tmp_path):
    path = tmp_path / "mine.safetensors"
    curious = {**POLICY.params, "curiosity": {"of": np.ones(2)}}
    save_policy(path, POLICY._replace(params=curious))
    loaded = load_policy(path)
    assert loaded._replace(params=None) == POLICY._replace(params=None)
    assert_same(loaded.params, POLICY.params)
    with enable_x64(True):
        assert_same(load_policy(path).params, POLICY.params)
    assert list(tmp_path.iterdir()) == [path]


def header(iteration: int | str = 1, **settings):
    values = {"config": {**CONFIG.to_dict(), **settings}, "iteration": iteration}
    return {"json": json.dumps(values)}


@pytest.mark.parametrize(
    ("stored", "changes", "message"),
    [
        *(
            (header, {}, "is not a file of arrays of this package")
            for header in ({}, *({"json": text} for text in ("{", "[]", "[" * 100_000)))
        ),
        ({"json": '{"config": []}'}, {}, "does not hold a policy of this version"),
        (header(iteration="x"), {}, "does not hold a policy of this version"),
        (header(clip=0.2), {}, "unknown setting 'clip'"),
        (header(hidden=5), {}, r"core/params/bias is float32\[2, 12\], not float32\[2, 15\]"),
        (header(encoder="own"), {}, "unknown encoder 'own'.*--import MODULE"),
        (header(), {"heads/params/more": np.ones(1)}, "heads/params/more is not expected"),
        (header(), {"heads/params/value/bias": None}, "heads/params/value/bias is missing"),
        (
            header(),
            {"heads/params/value/bias": np.array([np.nan], np.float32)},
            "parameters that are not finite: heads/params/value/bias",
        ),
    ],
)
def test_files_of_other_content_are_refused(stored, changes, message, tmp_path):
    path = tmp_path / "mine.safetensors"
    arrays = {name: array for name, array in {**ARRAYS, **changes}.items() if array is not None}
    path.write_bytes(safetensors.numpy.save(arrays, stored))
    with pytest.raises(ValueError, match=message) as error:
        load_policy(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-1], lambda b: b[:100], lambda b: b"", lambda b: b[1:]]
)
def test_damaged_files_are_refused(damage, tmp_path):
    path = tmp_path / "mine.safetensors"
    save_policy(path, POLICY)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"mine\.safetensors is not a file of arrays"):
        load_policy(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="mine"):
        load_policy(tmp_path / "mine.safetensors")
