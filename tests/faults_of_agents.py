"""Faults of the agents for `mutation_check.py`, each with the tests that should see it."""

from faults import Fault

LEARNER = ("tests/test_learner.py",)
ADVANTAGES = ("tests/test_advantages.py",)
CURIOSITIES = ("tests/test_explorers.py", "-k", "rnd")
INITIAL = ("tests/test_initialisation.py",)
TASKS = ("tests/test_experiment_runs.py", "-k", "test_tasks")
COUNTS = ("tests/test_curiosity.py", "-k", "share")
KEYS = (*("tests/test_rollout.py", "tests/test_learner.py"), *("-k", "a_key_of or no_key"))
EXTENDED = ("tests/test_train.py", "-k", "extended")
TRACES = ("tests/test_traces.py", "-k", "anew or nothing")


AGENT_FAULTS = (
    Fault(
        "agents/ppo/advantages",
        "the task's value is the curiosity's",
        "episodes.reward, episodes, value[..., 0]",
        "episodes.reward, episodes, value[..., 1]",
        ADVANTAGES,
    ),
    Fault(
        "agents/ppo/advantages",
        "the curiosity's returns deviate by more",
        "RETURN_DEVIATION = 0.3",
        "RETURN_DEVIATION = 0.6",
        ADVANTAGES,
    ),
    Fault(
        "agents/ppo/advantages",
        "the curiosity's rewards are scaled by their own deviation",
        "returns.discounted_returns(novelty, gamma), mask",
        "novelty, mask",
        ADVANTAGES,
    ),
    Fault(
        "agents/ppo/advantages",
        "finishing early costs novelty",
        "jnp.where(goes_on > 0, value, jnp.mean(value[0]))",
        "jnp.where(goes_on > 0, value, 0)",
        ADVANTAGES,
    ),
    Fault(
        "agents/ppo/learner",
        "the weight of the curiosity never falls",
        "(config)(state.iteration)",
        "(config)(0)",
        LEARNER,
    ),
    Fault(
        "agents/ppo/learner",
        "solved tasks are replayed",
        "reset_keys, ~batch.episodes.solved, again",
        "reset_keys, batch.episodes.solved, again",
        LEARNER,
    ),
    Fault(
        "agents/ppo/learner",
        "replayed tasks count as new ones",
        "episodes.solved[: config.num_new]",
        "episodes.solved[:]",
        LEARNER,
    ),
    Fault(
        "agents/ppo/learner",
        "the agent does not face the food",
        "if self.config.facing:",
        "if False:",
        LEARNER,
    ),
    Fault(
        "agents/ppo/learner",
        "all epochs have one order",
        "jax.vmap(permute)(jax.random.split(key, config.epochs))",
        "jax.vmap(permute)(jnp.stack([key] * config.epochs))",
        LEARNER,
    ),
    Fault(
        "agents/ppo/learner",
        "minibatches are drawn anew",
        "order = jax.random.permutation(epoch_key, config.episodes)",
        "order = jax.random.randint(epoch_key, (config.episodes,), 0, config.episodes)",
        LEARNER,
    ),
    Fault(
        "agents/curiosity/rnd",
        "the target learns, too",
        "jax.lax.stop_gradient(self.target(observation))",
        "self.target(observation)",
        CURIOSITIES,
    ),
    Fault(
        "agents/curiosity/rnd",
        "the observation that is left is paid",
        "jnp.sum(jnp.square(experience.features[1:])",
        "jnp.sum(jnp.square(experience.features[:-1])",
        CURIOSITIES,
    ),
    Fault(
        "agents/curiosity/counts",
        "all layouts share their counts",
        "jnp.stack([layout, position.astype(jnp.uint32)], axis=-1)",
        "position.astype(jnp.uint32)[..., None]",
        COUNTS,
    ),
    Fault(
        "agents/curiosity/counts",
        "layouts of near hashes share their counts",
        "jnp.stack([layout, position.astype(jnp.uint32)], axis=-1)",
        "(layout + position.astype(jnp.uint32))[..., None]",
        COUNTS,
    ),
    Fault(
        "agents/acting/rollout",
        "all steps draw their actions with one key",
        "keys = jax.random.split(key, len(times))",
        "keys = jnp.stack([key] * len(times))",
        KEYS,
    ),
    Fault(
        "agents/ppo/learner",
        "tasks are drawn with the key of the actions",
        "self.draw_tasks(state.failures, reset_key)",
        "self.draw_tasks(state.failures, action_key)",
        KEYS,
    ),
    Fault(
        "agents/ppo/learner",
        "`best` is not trained in an own environment",
        "if env is None:",
        'if env is None or config.encoder != "paper":',
        ("tests/test_config.py", "-k", "ones_own"),
    ),
    Fault(
        "agents/train",
        "`best` is always trained on its own set",
        "{} if selection.env is None else",
        '{} if selection.env is None or selection.preset == "best" else',
        ("tests/test_train.py", "-k", "asked_for"),
    ),
    Fault(
        "agents/experiments/protocol",
        "`best` is always trained on its own set",
        "return Config.preset(self.preset, **{**self.settings, **fixed, **changes})",
        'own = {"env_id": task_set("pstsy").id} if self.preset == "best" else {}\n'
        "        return Config.preset(self.preset, **{**self.settings, **fixed, **changes, **own})",
        ("tests/test_experiments.py", "-k", "any_sets"),
    ),
    Fault(
        "agents/runs/programs",
        "training is stopped by the tasks that are reported",
        '"validation")',
        '"test")',
        TASKS,
    ),
    Fault(
        "agents/experiments/training",
        "the purpose of tasks is not passed on",
        "config.num_features, purpose)",
        "config.num_features)",
        TASKS,
    ),
    Fault(
        "agents/experiments/training",
        "the best are chosen by the tasks that are reported",
        "protocol.tasks, protocol.selects_on)",
        'protocol.tasks, "test")',
        TASKS,
    ),
    Fault(
        "agents/experiments/protocol",
        "every protocol chooses by the tasks that it reports",
        'return "validation" if self.selection == "validation" else "test"',
        'return "test"',
        TASKS,
    ),
    Fault(
        "agents/experiments/reporting",
        "validation tasks are reported",
        'protocol.num_reported, "test")',
        'protocol.num_reported, "validation")',
        TASKS,
    ),
    Fault(
        "agents/runs/traces",
        "programs traced from other sources are taken up",
        "if head != self.code + hashlib.sha256(body).digest():",
        "if head[len(self.code) :] != hashlib.sha256(body).digest():",
        TRACES,
    ),
    Fault(
        "agents/runs/traces",
        "traces are kept where modules of one's own are imported",
        "            and not config.imports\n",
        "",
        TRACES,
    ),
    Fault(
        "agents/runs/folder",
        "a run whose curiosity's weight falls is extended",
        'for name in ("cooldown", "intrinsic_start"):',
        'for name in ("cooldown",):',
        EXTENDED,
    ),
    Fault(
        "agents/networks/core",
        "a head begins like a hidden layer",
        'output_dense(self.streams, name="value")',
        'dense(self.streams, name="value")',
        INITIAL,
    ),
)
