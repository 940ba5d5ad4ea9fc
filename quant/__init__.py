"""The numbers: calibration, power-of-two scales, INT8 graph writing and the float/INT8 gate.

float ONNX -> graph -> planes -> calibration -> scales -> host file (onnxruntime) and board file (DPU flow)
"""

from quant.telemetry import switch_off_telemetry

switch_off_telemetry()  # here, because a runtime's first import anywhere in this package is too late
