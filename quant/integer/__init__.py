"""The DPU's arithmetic in integers: the reference that every file is held to.

- `reference`: a core run on planes, layer by layer, and how far onnxruntime agrees;
- `arithmetic`: exact convolutions, maxima and means, and the DPU's fixed-point constants.
"""
