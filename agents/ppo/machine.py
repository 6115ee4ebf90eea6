"""Chooses the encoding, the unrolling of the GRU and the seeds per program for the machine.

A CPU gains from encoding each distinct observation once, in small chunks. Such chunks slow a GPU
or TPU: each is dozens of small kernels, launched by a loop whose length depends on the data. An
accelerator gains from unrolling the GRU instead, whose kernels are small, too.
"""

import importlib.util

import jax

from agents.acting.encoding import EncodeFn, Encoding, no_features
from agents.config import Config
from agents.networks.agent import Agent

UNROLLED_STEPS = 10  # of the GRU, per iteration of its loop on an accelerator


def on_cpu() -> bool:
    """Returns whether JAX computes on a CPU by default."""
    return jax.default_backend() == "cpu"


def make_agent(config: Config) -> Agent:
    """Builds the policy network; its parameters are the same on every machine."""
    return Agent(config, scan_unroll=1 if on_cpu() else UNROLLED_STEPS)


def make_encoding(agent: Agent, encode_for_curiosity: EncodeFn = no_features) -> Encoding:
    """Chooses the fast path on a CPU and the plain path elsewhere."""
    if on_cpu() and importlib.util.find_spec("agents.fast") is not None:
        from agents.fast import FastEncoding  # noqa: PLC0415  everything works without it

        return FastEncoding(agent, encode_for_curiosity)
    return Encoding(agent, encode_for_curiosity)


def seeds_share_programs(config: Config, backend: str) -> bool:
    """Returns whether seeds of these settings train faster in one program than one by one.

    On a CPU seeds train faster on a core each. If the network convolves, as every encoder but
    `objects` may, the kernels differ between seeds, for which GPUs have no fast program.
    """
    return backend != "cpu" and config.encoder == "objects"
