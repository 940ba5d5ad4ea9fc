"""A float file of anyone's becomes its simplest equal, before anything else looks at it.

- `folding`: what holds behind it, and what onnxruntime and onnx's converter do for it;
- `equivalents`: the rewritings that they lack, of `nodes`, fully connected layers as convolutions
  among them;
- `external`: weights in a file beside the model are taken in;
- `training_mode`: what was exported while it was trained is refused.
"""
