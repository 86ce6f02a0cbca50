"""Objects that no setting was chosen by, made in code, with their photos."""
