"""A float file of anyone's becomes its simplest equal, before anything else looks at it.

- `simplify`: what holds afterwards, and what onnxruntime and onnx's converter do for it;
- `standard_operators`, `fold_affine`, `fully_connected`: the passes that they lack, which edit a
  `quant.onnx.graph.OnnxGraph`;
- `training_mode`: refuses what was exported while it was trained.
"""
