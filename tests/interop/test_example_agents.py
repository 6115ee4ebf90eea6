"""The examples with agents of other libraries."""

import pytest

pytest.importorskip("rejax")
pytest.importorskip("stable_baselines3")

from agents.examples import rejax_agent, sb3_agent

pytestmark = [pytest.mark.interop, pytest.mark.filterwarnings("default")]


@pytest.mark.parametrize("example", [rejax_agent, sb3_agent])
def test_agents_of_other_libraries_are_trained_and_scored(example):
    scores = example.main()
    assert [score.set for score in scores.sets] == ["near-food", "base"]
    assert scores["near-food"].solved == 1
    assert scores["base"].solved == 0
