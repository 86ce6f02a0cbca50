"""Running CUDA kernels from torch without a CUDA toolkit: sources, compilation by NVRTC, the cache, launches."""
