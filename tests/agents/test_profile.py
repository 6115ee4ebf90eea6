"""The command python -m agents.profile, from sources to files."""

import json
from pathlib import Path

import jax
import pandas as pd
import pytest
from PIL import Image

from agents import profile
from agents.pretrained import FOLDER
from agents.profiles import plots, tasks
from helpers.refusal import refused


@pytest.fixture
def one_start(monkeypatch):
    """Plays controls from one cell, since solving them from all takes long."""
    monkeypatch.setattr(
        tasks, "with_every_start", lambda state: jax.tree.map(lambda x: x[None], state)
    )


@pytest.mark.usefixtures("one_start")
def test_results_are_written_and_printed_before_anything_is_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    source = Path(r"$\frac{$=0.1-x.safetensors")  # which Matplotlib would take for mathematics
    source.write_bytes((FOLDER / "fast-base.safetensors").read_bytes())
    options = "--parts structural first-push-p control --strengths 0 1 --tasks 2"
    arguments = ["fast-base", str(source), *options.split()]
    out = tmp_path / "runs" / r"profile-fast-base+$\frac{$=0.1-x"
    out.mkdir(parents=True)
    for name in ("profile.csv", "success.png"):
        (out / name).write_text("of an earlier profile")
    files = []
    shown = []
    draw = plots.save_success

    def note_files(found, path):
        files.extend(path.name for path in out.iterdir())
        shown.append(capsys.readouterr().out)
        draw(found, path)

    monkeypatch.setattr(plots, "save_success", note_files)
    profile.main(arguments)
    assert sorted(files) == ["profile.csv", "provenance.json"]
    assert "Controls solved directly" in shown[0]
    assert max(len(line.rstrip()) for line in shown[0].splitlines()) <= 80
    table = pd.read_csv(out / "profile.csv")
    one, two = (group.drop(columns="policy") for _, group in table.groupby("policy", sort=False))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), two.reset_index(drop=True))
    assert list(table["policy"].unique()) == ["fast-base", str(source)]
    assert json.loads((out / "provenance.json").read_text())["command"].endswith(options)
    for name in profile.FIGURES:
        with Image.open(out / name) as picture:
            assert picture.width == 830


def test_a_profile_of_other_policies_is_not_replaced(tmp_path, capsys):
    (tmp_path / "profile.csv").touch()
    (tmp_path / "provenance.json").write_text('{"iterations": {"icm-base": 19}}')
    message = refused(capsys, profile.main, "fast-base", "--output", tmp_path)
    assert f"{tmp_path} holds the profile of other policies; give another --output" in message


@pytest.mark.parametrize("name", ["config.json", "grid.json"])
def test_a_profile_does_not_mix_with_other_files(name, tmp_path, capsys):
    (tmp_path / name).touch()
    message = refused(capsys, profile.main, "fast-base", "--output", tmp_path)
    assert f"{tmp_path} holds other files than a profile's; give another --output" in message
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_profile_inside_a_file_is_refused_before_it_plays(tmp_path, capsys):
    (tmp_path / "x").touch()
    for output in (tmp_path / "x", tmp_path / "x" / "y" / "z"):
        message = refused(capsys, profile.main, "fast-base", "--output", output)
        assert f"{tmp_path / 'x'} is not a folder; give another path" in message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: RUNS"),
        (["fast-base", "--import", "no.such"], "no.such"),
        (["fast-base", "--tasks", "0"], "tasks must be an integer"),
        (["fast-base", "--parts", "swaps"], "allowed: one or more of structural, perceptual"),
        (["fast-base", "--parts"], "expected at least one argument"),
        (["fast-base", "--strengths", "1.5"], "strength must be a number from 0 to 1"),
    ],
)
def test_the_command_line_refuses(arguments, message, capsys, tmp_path):
    with pytest.raises(SystemExit):
        profile.main([*arguments, "--output", str(tmp_path / "x")])
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
