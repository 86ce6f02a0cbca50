"""Pages and pictures made from a run directory alone."""
