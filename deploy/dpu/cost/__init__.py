"""How long a network takes on the DPU, at what power, and how the constants behind that are fitted."""
