"""What a network takes: measured on this machine, predicted for the DPU, published by the paper, side by side."""
