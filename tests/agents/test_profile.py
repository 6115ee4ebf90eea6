"""The command python -m agents.profile, from sources to files."""

import json

import pandas as pd
import pytest
from PIL import Image

from agents import profile as command
from agents.pretrained import FOLDER


def test_files_are_written_before_anything_is_printed(tmp_path, monkeypatch):
    source = str(FOLDER / "fast-base.safetensors")
    arguments = ["fast-base", source, "--parts", "structural", "control"]
    arguments += ["--strengths", "0", "1", "--tasks", "2", "--output", str(tmp_path / "out")]

    def refuse(*values):
        assert len(list((tmp_path / "out").iterdir())) == 4
        raise RuntimeError("the terminal is gone")

    monkeypatch.setattr("builtins.print", refuse)
    with pytest.raises(RuntimeError, match="terminal"):
        command.main(arguments)
    table = pd.read_csv(tmp_path / "out" / "profile.csv")
    one, two = (group.drop(columns="policy") for _, group in table.groupby("policy", sort=False))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), two.reset_index(drop=True))
    assert list(table["policy"].unique()) == ["fast-base", source]
    provenance = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert provenance["command"].startswith("python -m agents.profile fast-base ")
    assert provenance["jax"]
    for name in ("success.png", "controls.png"):
        with Image.open(tmp_path / "out" / name) as picture:
            assert picture.width == 830


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one or more runs' folders"),
        (["none"], "none"),
        (["fast-base", "--import", "no.such"], "no.such"),
        (["fast-base", "--tasks", "0"], "evaluation tasks must be"),
        (["fast-base", "--parts", "swaps"], "allowed: one or more of structural, perceptual"),
        (["fast-base", "--strengths", "1.5"], "strength must be a number from 0 to 1"),
    ],
)
def test_the_command_line_refuses(arguments, message, capsys, tmp_path):
    with pytest.raises(SystemExit):
        command.main([*arguments, "--output", str(tmp_path)])
    assert message in capsys.readouterr().err
