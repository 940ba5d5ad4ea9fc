"""Read and write files, each completely or not at all; images are read by `model.raster`.

- `files`: outputs that are written completely, and never over an input; `lock`: one run at a time;
- `tensors`: weights as safetensors; `formats`: network files that are not supported;
- `pictures`: pictures of images for pages.
"""
