"""The traditional pipeline, on the CPU and without training: what a network has to beat.

1. `stabilise`: radiance to a scale on which the sensor's noise has variance 1 everywhere.
2. `nl_bayes`: two-pass non-local Bayes denoising (`patches` finds the groups, `estimate` does the statistics,
   `settings` holds the published numbers, `threads` shares the tiles out).
3. `stabilise` again, backwards: to radiance.
4. `compensate`: regularised inverse filter, from the degraded sensor's MTF to the reference's.

`pipeline` chains them. Denoising comes first: there the noise is still white, as NL-Bayes assumes.
"""
