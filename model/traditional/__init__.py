"""The traditional pipeline, on the CPU and without training: the baseline for a network.

1. `noise`: radiance to a scale on which the sensor's noise has variance 1 everywhere, and back
   again after 2.
2. `nl_bayes`: two-pass non-local Bayes denoising, with the published parameters (`patch_groups`).
3. `compensate`: regularised inverse filter, from the degraded sensor's MTF to the reference's;
   `regularisation` derives its strength from the noise and the contrast of the image.

`pipeline` runs them in this order, or with 3 first. `baselines` has methods of scikit-image to
compare it with. Every step accepts and returns strips of rows (`rows`), so an image of any height
needs the memory of some hundred rows. NaN marks missing pixels.
"""
