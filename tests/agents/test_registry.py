"""Names of curiosities and encoders: yours, and the built-in ones."""

import pytest

from agents import Config
from agents.curiosity import Curiosity, register
from agents.registry import Registry, curiosities
from helpers.refusal import assert_refused


def test_a_name_of_yours_is_allowed_and_may_be_registered_again(fresh_names):
    register("mine", print)
    register("mine", Curiosity)
    assert curiosities.factory("mine") is Curiosity
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


@pytest.mark.parametrize("setting", ["curiosity", "encoder"])
def test_unknown_names_are_refused_with_the_known_ones_and_the_way_to_add_more(setting):
    known = {"curiosity": "icm, rnd", "encoder": "paper, objects"}[setting]
    words = [f"unknown {setting} 'rdn'; allowed: {known}", "--import MODULE", "imports="]
    assert_refused(words, Config, **{setting: "rdn"})
