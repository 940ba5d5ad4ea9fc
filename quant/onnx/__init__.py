"""ONNX files below the level of operations that a DPU computes.

- `graph`: the one graph of a file, which passes edit and all other code reads; `window`: the motion
  of its windows, and `resize`: its enlargements;
- `elementwise`: the operators that work on each value by itself;
- `messages`: the constants, sizes and repeated fields of a file's messages;
- `node_order`: sorts nodes such that each reads only what was written before;
- `image_input`: the image that a network takes, and the size that it is fixed to;
- `runnable`: whether a runtime may open a file;
- `external_weights`: loads weights from a file next to the model.
"""
