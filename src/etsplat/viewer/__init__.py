"""An interactive view of a trained soup in a web browser."""
