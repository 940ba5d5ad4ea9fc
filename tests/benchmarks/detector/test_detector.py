"""The small detector is one of our classes, and its file states its recipe."""

from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.studies.detection.detector import open_detector
from benchmarks.detector.demonstration import DETECTOR
from benchmarks.detector.scenes import CLASSES


def test_it_is_read_as_a_detector_of_our_classes_and_states_its_recipe() -> None:
    detector = open_detector(DETECTOR, 1)
    assert (detector.names, detector.size_px, detector.flag) == (CLASSES, 256, "")
    assert "steps=2000" in metadata(load_onnx(DETECTOR))["recipe"]
