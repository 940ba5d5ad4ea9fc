"""The numbers: calibration, power-of-two positions, INT8 graph writing and the float/INT8 gate.

float ONNX -> graph -> planes -> calibration -> positions -> host file (onnxruntime) and board file (DPU flow)
"""

from quant.silence import silence_runtimes

silence_runtimes()  # here, because a runtime's first import anywhere in this package is too late
