"""Read and write files, each completely or not at all; images are read by `model.raster`.

- `files`: outputs that are written completely, and never over an input;
- `tensors`: weights as safetensors.
"""
