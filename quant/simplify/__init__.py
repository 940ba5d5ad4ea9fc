"""A float file of anyone's becomes its simplest equal, before anything else looks at it.

- `simplify`: what holds afterwards, and what onnxruntime and onnx's converter do for it;
- `standard_operators`, `spelled_activations`, `fold_affine`, `split_channels`, `strided_slices`,
  `large_kernels`, `crop_borders`, `fully_connected`: the passes that they lack, which edit a
  `quant.onnx.graph.OnnxGraph`;
- `channels_first`, `free_sizes`, `missing_border`: what concerns the image of a network: the order
  of its axes, arithmetic on its size, and the border that a network without padding lacks;
- `training_mode`: refuses what was exported while it was trained.
"""
