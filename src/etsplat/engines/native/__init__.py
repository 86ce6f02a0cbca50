"""What the engines of native code share."""
