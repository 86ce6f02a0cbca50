"""Gaussian splatting with gsplat, beside our methods."""
