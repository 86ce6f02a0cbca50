"""Posed photos and the points seen in them: data sets, where they come from, and what is built in code."""
