"""One module per differentiable operation, its reference and its native calls side by side."""
