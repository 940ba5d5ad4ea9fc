"""The DPU's arithmetic in integers: the reference with which every file is compared.

- `reference`: a core run on planes, layer by layer; `agreement`: its comparison with onnxruntime;
- `arithmetic`: exact convolutions, maxima and means, and the DPU's fixed-point constants;
- `trainable`: the same arithmetic in torch, with gradients.
"""
