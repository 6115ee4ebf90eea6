"""The command python -m agents.profile, from sources to files."""

import json

import pandas as pd
import pytest
from PIL import Image

from agents import profile
from agents.pretrained import FOLDER


def test_files_are_written_before_anything_is_printed(tmp_path, monkeypatch):
    source = str(FOLDER / "fast-base.safetensors")
    out = tmp_path / "out"
    options = f"--parts structural control --strengths 0 1 --tasks 2 --output {out}"

    def refuse(*values):
        assert len(list(out.iterdir())) == 4
        raise RuntimeError("the terminal is gone")

    monkeypatch.setattr("builtins.print", refuse)
    with pytest.raises(RuntimeError, match="terminal"):
        profile.main(["fast-base", source, *options.split()])
    table = pd.read_csv(out / "profile.csv")
    one, two = (group.drop(columns="policy") for _, group in table.groupby("policy", sort=False))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), two.reset_index(drop=True))
    assert list(table["policy"].unique()) == ["fast-base", source]
    assert json.loads((out / "provenance.json").read_text())["command"].endswith(options)
    for name in ("success.png", "controls.png"):
        with Image.open(out / name) as picture:
            assert picture.width == 830


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: RUNS"),
        (["fast-base", "--import", "no.such"], "no.such"),
        (["fast-base", "--tasks", "0"], "evaluation tasks must be"),
        (["fast-base", "--parts", "swaps"], "allowed: one or more of structural, perceptual"),
        (["fast-base", "--strengths", "1.5"], "strength must be a number from 0 to 1"),
    ],
)
def test_the_command_line_refuses(arguments, message, capsys, tmp_path):
    with pytest.raises(SystemExit):
        profile.main([*arguments, "--output", str(tmp_path)])
    assert message in capsys.readouterr().err
