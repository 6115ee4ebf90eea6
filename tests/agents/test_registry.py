"""Names of curiosities and encoders: yours, and the built-in ones."""

import pytest

from agents import Config
from agents.curiosity import Curiosity, register
from agents.registry import Registry, curiosities
from helpers.refusal import assert_refused


def test_a_name_of_yours_is_allowed_and_may_be_registered_again(fresh_names):
    register("mine", print)
    register("mine", ours := lambda config, env: Curiosity())
    assert curiosities.factory("mine") is ours
    assert Config(curiosity="mine").curiosity == "mine"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a", ["reward 'a' is built in", "a, b"]),
        ("a+b, c", ["reward names consist of letters, digits", "'a+b, c'"]),
        (7, ["reward names consist of letters, digits", "got 7"]),
    ],
)
def test_unusable_names_are_refused(name, words):
    registry = Registry("reward")
    registry.update(a=Curiosity, b=Curiosity)
    assert_refused(words, registry.register, name, Curiosity)


@pytest.mark.parametrize("factory", [Curiosity, Curiosity(), lambda config: Curiosity(), None])
def test_a_factory_that_cannot_be_called_is_refused(factory):
    words = ["curiosity 'mine' needs a function of (config, env): "]
    assert_refused(words, register, "mine", factory)
    assert "mine" not in curiosities


@pytest.mark.parametrize("setting", ["curiosity", "encoder"])
def test_unknown_names_are_refused_with_the_known_ones_and_the_way_to_add_more(setting):
    known = {"curiosity": "icm, rnd", "encoder": "paper, objects"}[setting]
    words = [f"unknown {setting} 'xyz'; allowed: {known}", "--import MODULE", "imports="]
    assert_refused(words, Config, **{setting: "xyz"})
    assert_refused(["unknown curiosity 'rdn' (did you mean 'rnd'?)"], Config, curiosity="rdn")
