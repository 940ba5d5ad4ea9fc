"""ONNX files below the level of operations that a DPU computes.

- `graph`: the one graph of a file, which passes edit and everything else reads; `window`: how its
  windows move;
- `runnable`: whether a runtime may open a file;
- `external_weights`: weights in a file beside the model are taken in.
"""
