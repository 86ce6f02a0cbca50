"""Cameras, the kernel registry, validation and errors: what every other layer speaks in."""
