"""Agents of other libraries learn an easy task through the adapters."""

import importlib

import pytest

pytestmark = [pytest.mark.interop, pytest.mark.filterwarnings("default")]


@pytest.mark.parametrize(
    ("library", "example"), [("rejax", "rejax_agent"), ("stable_baselines3", "sb3_agent")]
)
def test_agents_of_other_libraries_are_trained_and_scored(library, example):
    pytest.importorskip(library)
    scores = importlib.import_module(f"agents.examples.{example}").main()
    assert [score.set for score in scores.sets] == ["near-food", "base"]
    assert scores["near-food"].solved == 1
    assert scores["base"].solved == 0
