"""Holds tasks, checks and references that several tests share."""
