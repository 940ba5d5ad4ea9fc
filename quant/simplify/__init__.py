"""Simplify a float file of any exporter before any other code reads it.

- `simplify`: the guarantees afterwards, and the use of onnxruntime and of onnx's converter;
- `standard_operators`, `spelled_activations`, `fold_affine`, `image_residual`, `image_mixtures`,
  `channels`, `branches`, `slices`, `convolutions`, `fully_connected`: the passes that these lack,
  which edit a `quant.onnx.graph.OnnxGraph`;
- `channels_first`, `free_sizes`, `missing_border`: passes on the image of a network: the order of
  its axes, arithmetic on its size, and the border that a network without padding lacks;
- `rearrangements`: what only moves values, as one operator;
- `activations_first`: moves activations directly behind their convolutions;
- `training_mode`: rejects networks that were exported in training mode.
"""
