"""What restoration buys a detector: labelled images, a detector of the user's or ours, and scores with intervals.

- `boxes`: boxes, their overlap, suppression, and the square input of a detector;
- `classes`: names of classes matched by letters; `annotations`: labelled images of any known layout (`voc`, `coco`,
  `text_labels`);
- `detectors`: detectors as Ultralytics exports them to ONNX, run here;
- `scores`: average precision, precision and recall, and what differs between rows with an interval.
"""
