"""What the DPU can run: its rules, one small function each, and where each node of a network goes."""
