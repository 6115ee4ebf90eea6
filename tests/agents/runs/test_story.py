"""What the end of a run says to its reader."""

from pathlib import Path

import numpy as np
import pytest

import trap_tube_jax as tt
from agents.config import Config
from agents.runs import story as stories
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import FirstSolved
from agents.runs.story import resume_command
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import ALL_SETS, label

FIRST = FirstSolved(iteration=3, episodes=3763, transitions=9, seconds=1.0)


def scores(own, percent, others):
    """Each set has ten tasks."""
    made = []
    for name in dict.fromkeys([own, *ALL_SETS]):
        solved = np.arange(10) < (percent if name == own else others) // 10
        made.append(Score.of(name, label(name), solved, np.full(10, 5)))
    return made


def story(tmp_path, own, percent, others, *, is_solved=True, **settings):
    run = Run(Config.preset("paper", env_id=own, iterations=7, **settings))
    folder = RunFolder(tmp_path / "x")
    return stories.story(
        folder,
        run,
        [scores(own, percent, others)],
        [FIRST if is_solved else None],
        resume_command(folder, "--devices", "2"),
    )


def test_a_run_that_solves_base_says_so_and_points_onward(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "solved.gif").write_bytes(b"")
    before, after = story(tmp_path, "base", 100, 0)
    text = "\n".join(before)
    assert "Learnt: to get the food out of the tube with the tool, on the base task" in text
    assert "after 3,763 episodes." in text
    assert f"Watch a solved episode: {tmp_path / 'x' / 'solved.gif'}" in text
    assert "It does not transfer: on the sets other than base" in text
    assert "python -m agents.train --preset best" in after[-1]


@pytest.mark.parametrize(
    ("others", "verdict"), [(10, "does not transfer"), (50, "transfers in part"), (90, "transfers")]
)
def test_transfer_is_named_by_what_is_solved(tmp_path, others, verdict):
    before, after = story(tmp_path, "pstsy", 90, others)
    assert f"It {verdict}: on the sets other than {{P, St, Sy}}" in before[-1]
    assert f"it solves {others}.0 % of the tasks on average" in before[-1]
    assert after[-1].endswith("--optimality")


def test_a_run_that_has_not_learnt_is_to_be_continued(tmp_path):
    before, after = story(tmp_path, "base", 0, 0, is_solved=False)
    text = "\n".join(before)
    assert "Learnt so far: trained on the base task" in text
    assert "so there is none to watch" in text
    assert "transfer:" not in text
    assert f"--resume --name x --out {tmp_path} --devices 2 --iterations 14" in after[-1]
    assert "--stop-when-solved" not in after[-1]
    _, after = story(tmp_path, "pstsy", 60, 0, stop_when_solved=0.5)  # which has ended it
    assert after[-1].endswith("--iterations 14 --stop-when-solved 0")
    _, after = story(tmp_path, "base", 0, 0, is_solved=False, cooldown=0.5)  # not to be extended
    assert "--resume" not in after[-1]


def test_commands_can_be_typed_as_they_are_shown():
    folder = RunFolder(Path("runs/x"))
    assert resume_command(folder) == "python -m agents.train --resume --name x"
    folder = RunFolder(Path("my runs/x y"))
    shown = "python -m agents.train --resume --name 'x y' --out 'my runs' --devices all"
    assert resume_command(folder, "--devices", "all") == shown


@pytest.mark.parametrize("is_solved", [True, False])
def test_a_set_of_ones_own_is_said_to_have_food_and_no_more(tmp_path, own_task_sets, is_solved):
    tt.register("Tubeless-v0", (), short="tubeless", max_steps=20)
    before, after = story(tmp_path, "tubeless", 90, 0, is_solved=is_solved)
    text = "\n".join(before)
    assert (
        "Learnt: to reach the food, on" if is_solved else "the agent reaches the food in"
    ) in text
    assert "tube " not in text
    assert "--preset best" not in after[-1]
    assert after[-1].endswith("--optimality")
