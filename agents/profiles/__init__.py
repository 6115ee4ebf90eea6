"""Profiles of trained agents: success by distance from the base task and by kind of task.

tasks.py      the tasks of each part of a profile
subgoals.py   the last subgoal that an episode reached
measure.py    greedy play on these tasks, as a tidy table, and smaller tables made from it
figures.py    the figures
"""
