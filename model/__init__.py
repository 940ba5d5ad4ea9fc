"""The science: computations on images, and the networks.

It imports `profiles` and nothing else of this project.

- `convbeers`: the network, plain and behind the bank of a sensor's filters (`bank`); `family`: the
  sensors that the latter is trained on, and the sensor vector that it is conditioned on;
- `simulator`: from a scene's radiance to digital numbers; `traditional`: the baseline pipeline
  without training;
- `dataset`: pairs on disk, and the sensors and scenes that made them; `training`: runs that produce
  weights;
- `exposure`: brightens dark parts for a network; `consistency`: makes a restored image consistent
  with the raw one; `self_check`: checks that; `interval`: the likely error of each pixel;
- `metrics`: the quality of a restored image; `departure`: how a sensor's MTF differs from those
  that networks were trained on;
- `raster`: images on disk; `io`: other files; `shipped`: the location of the shipped weights;
  `variants`: their sizes; `processor`: the behaviour of this machine's kernels;
- `progress`: progress reports of long work, and how Ctrl-C stops it.

It exports no names itself, so that finding a file or reading an image does not load torch.
"""
