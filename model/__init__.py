"""The science: what is computed on images, and the networks.

It imports `profiles` and nothing else of ours.

- `convbeers`: the network, plain and behind the bank of a sensor's filters (`bank`); `family`: the
  sensors that the latter is trained on, and what it is told of each;
- `simulator`: from a scene's radiance to digital numbers; `traditional`: the pipeline that a
  network has to beat;
- `dataset`: pairs on disk, and the sensors and scenes that made them; `training`: runs that make
  weights;
- `metrics`: what a restored image is worth;
- `io`: images and tensors on disk; `shipped`: where our weights lie; `processor`: what this
  machine's kernels do;
- `progress`: what long work shows, and how Ctrl-C stops it.

It offers no names of its own, so that finding a file or reading an image loads no torch.
"""
