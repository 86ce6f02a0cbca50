"""Topology, subdivision plans, surface sampling and distances: no parameters, no losses."""
