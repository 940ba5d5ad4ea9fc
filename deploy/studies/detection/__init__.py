"""Measure the gain of restoration for an object detector: labelled scenes, a detector, and average
precision with intervals.

- `labels`: labelled images of VOC, DIOR and COCO;
- `boxes`: boxes and the square input of a detector; `detector`: detectors as Ultralytics exports
  them to ONNX;
- `average_precision`: average precision, precision and recall, with a bootstrap over sites;
- `study`: the comparison; `tables`: its table of figures; `page`: its page.
"""
