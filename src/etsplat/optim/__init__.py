"""Objectives, schedules, the loop, checkpoints and the one place that edits primitives."""
