"""What is read from disk and written to it, whole files or none; images are `model.raster`'s.

- `files`: outputs that are written whole, and never over an input;
- `tensors`: weights as safetensors.
"""
