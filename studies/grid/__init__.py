"""Runs beside each other, each resumable: what they are, how they stand, and what their tables share."""
