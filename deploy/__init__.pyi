from .dpu.board import load_dpu as load_dpu
from .dpu.checker.placement import place as place
from .dpu.cost.latency import predict as predict
from .dpu.reading import read_network as read_network
from .export import float_for as float_for
from .export import float_model as float_model
from .export import to_onnx as to_onnx
from .gate import run_gate as run_gate
from .library import restore as restore
from .results import Document as Document

__version__: str
