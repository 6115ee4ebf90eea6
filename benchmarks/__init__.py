"""Benchmarks of the environment and of training, as commands anybody can run."""
