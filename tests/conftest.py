"""Settings that hold for every test, made before any of them touches JAX."""

import jax

# An accidental broadcast between ranks is a bug that a shape test may not see.
jax.config.update("jax_numpy_rank_promotion", "raise")
# A cache left by another version of the code must not decide what is tested.
jax.config.update("jax_enable_compilation_cache", False)
