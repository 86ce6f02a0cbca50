"""Native code on the CPU (csrc/cpu), with the GIL released."""
