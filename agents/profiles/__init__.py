"""Profiles of trained agents: success by distance from the base task and by kind of task."""
