"""The sensor simulator: from a scene's radiance to the digital numbers of an instrument.

A scene passes through `mtf` (blur, in Fourier), `sampling` (the coarser grid), `noise` and `digitise`; `acquire`
puts them in that order, and `draws` gives each random effect its own generator.
"""
