"""Profiles: how a policy's success falls with the distance from the base task, and where it errs.

    tasks.py      the tasks, point by point
    oracle.py     distances to the goal along episodes
    mistakes.py   where an episode leaves the shortest way, and how far it comes
    measure.py    plays and compares all of it; the record
    summary.py    what a record comes to: percentages, intervals, counts
    tables.py     the tables of a record
    figures.py    its figures

The command line is `agents/profile.py`.
"""
