"""Image and geometry metrics, each with its convention."""
