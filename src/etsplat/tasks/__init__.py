"""A config goes in, a run directory comes out."""
