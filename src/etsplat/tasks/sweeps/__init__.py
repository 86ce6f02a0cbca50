"""Many runs: what they are, where they run (this machine, Ray, Slurm), and how they get to their ends."""
