"""Programs for accelerators, of which the machine that runs the tests may have none.

All are lowered for CUDA and TPU. After `pip install 'jax[cuda12]'`, `JAX_PLATFORMS=cpu pytest -m
slow tests/test_platforms.py` has XLA compile them for H200 GPUs, which need not be there. Neither
runs them.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax.experimental import topologies
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import trap_tube_jax as tt
from agents import Config, make_train
from agents.parallel.sharding import EPISODES, SEEDS, Placement
from agents.registry import curiosities
from agents.runs.programs import PHASES

PLATFORMS = ("cpu", "cuda", "tpu")
TINY = Config(
    env_id="sy",
    max_steps=4,
    episodes_per_iteration=4,
    minibatch_size=2,
    epochs=1,
    filters=(2, 3),
    hidden=4,
    embedding=2,
    encode_chunk_size=4,
).to_dict()
OBJECTS = {"curiosity": "rnd", "encoder": "objects"}
CURIOSITIES = curiosities.names()
# What XLA wants to know of a GPU that it cannot ask.
H200 = """
platform_name: "CUDA"
device_description_str: "NVIDIA H200"
runtime_version { major: 12 minor: 9 patch: 0 }
dnn_version_info { major: 9 minor: 8 }
gpu_device_info {
  cuda_compute_capability { major: 9 }
  core_count: 132
  fpus_per_core: 128
  clock_rate_ghz: 1.98
  memory_bandwidth: 4800000000000
  device_memory_size: 150000000000
  l2_cache_size: 52428800
  threads_per_warp: 32
  threads_per_block_limit: 1024
  threads_per_core_limit: 2048
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  registers_per_block_limit: 65536
  registers_per_core_limit: 65536
  shared_memory_per_block: 49152
  shared_memory_per_block_optin: 232448
  shared_memory_per_core: 233472
}
"""
# No measuring of alternatives, and no kernels that cannot be had without it.
NOTHING_MEASURED = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}


def lowered_for(function: Any, *arguments: Any) -> tuple[str, ...]:
    exported = export.export(jax.jit(function), platforms=PLATFORMS)(*arguments)
    assert exported.mlir_module_serialized
    return exported.platforms


def test_the_environment_lowers_for_accelerators():
    env = tt.make("pstsy")
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 2))
    assert lowered_for(jax.vmap(env.reset), keys) == PLATFORMS


@pytest.mark.parametrize("settings", [{}, OBJECTS], ids=["icm", "objects"])
def test_training_lowers_for_accelerators(settings):
    train = make_train(Config.from_dict({**TINY, **settings}))
    state = jax.eval_shape(train.init, jax.random.key(0))
    assert lowered_for(train.iterate, state) == PLATFORMS


@pytest.fixture(scope="module")
def gpus() -> list[Any]:
    """Four H200 to compile for."""
    try:
        return topologies.get_topology_desc(
            "h200", "cuda", target_config=H200, topology="1x1x4"
        ).devices
    except NotImplementedError:
        pytest.skip("needs jax[cuda12], and JAX_PLATFORMS=cpu where there is no driver")


def machine_code(sharding: NamedSharding, function: Any, *arguments: Any) -> str | None:
    there = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), arguments
    )
    return jax.jit(function).lower(*there).compile(NOTHING_MEASURED).as_text()


def on_one(gpus: list[Any]) -> NamedSharding:
    return NamedSharding(Mesh(np.array(gpus[:1]), "gpu"), PartitionSpec())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["base", "pstsy"])
def test_the_environment_compiles_for_a_gpu(gpus, name):
    env = tt.make(name)
    vector = tt.VectorEnvironment(env)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 64))
    actions = jax.ShapeDtypeStruct((64, 2), jnp.int32)
    for reset, step in ((jax.vmap(env.reset), jax.vmap(env.step)), (vector.reset, vector.step)):
        states, _ = jax.eval_shape(reset, keys)
        assert machine_code(on_one(gpus), reset, keys)
        assert machine_code(on_one(gpus), step, states, actions)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [OBJECTS, *({"curiosity": name} for name in CURIOSITIES)],
    ids=["objects", *CURIOSITIES],
)
def test_training_compiles_for_a_gpu(gpus, settings):
    train = make_train(Config.from_dict({**TINY, **settings}))
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 2))
    states = jax.eval_shape(jax.vmap(train.init), keys)
    assert machine_code(on_one(gpus), jax.vmap(train.init), keys)
    assert machine_code(on_one(gpus), jax.vmap(train.iterate), states)  # two seeds side by side


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, OBJECTS], ids=["icm", "objects"])
def test_training_compiles_for_several_gpus(gpus, settings):
    mesh = Mesh(np.array(gpus).reshape(2, 2), (SEEDS, EPISODES))
    placement = Placement(mesh)
    config = Config.from_dict({**TINY, **settings})
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 4))
    states = jax.eval_shape(jax.vmap(make_train(config).init), keys)
    train = make_train(config, shards=placement.episodes)
    sharding = NamedSharding(mesh, PartitionSpec(SEEDS))
    inputs: Any = (states, None)
    code = ""
    for phase in (placement.shard(make(train)) for make in PHASES):
        active = jax.ShapeDtypeStruct((4,), bool)
        code += machine_code(sharding, phase, *inputs, active) or ""
        inputs, _ = jax.eval_shape(phase, *inputs, active)
    assert "all-reduce" in code  # the gradients' mean
    assert "all-gather" in code  # the episodes
