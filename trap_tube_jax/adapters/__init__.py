"""Adapters to the interfaces of other libraries. Each module needs its library.

to_gymnasium: `gymnasium.make` and `gymnasium.make_vec`.
to_gymnax: the five-value step of gymnax 0.x, and `gymnax.make` of gymnax >= 1.0.

`pip install 'trap-tube-jax[gymnasium,gymnax]'` installs both libraries.
"""
