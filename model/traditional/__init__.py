"""The traditional pipeline, on the CPU and without training: what a network has to beat.

1. `stabilise`: radiance to a scale on which the sensor's noise has variance 1 everywhere.
2. `nl_bayes`: two-pass non-local Bayes denoising (`passes` runs one, `patches` finds the groups, `estimate` does the
   statistics, `noise` says what is noise, `settings` holds the published numbers, `threads` shares the tiles out).
3. `stabilise` again, backwards: to radiance.
4. `compensate`: regularised inverse filter, from the degraded sensor's MTF to the reference's.

`pipeline` chains them, in this order or with 4 first. Every step takes and gives strips of rows (`rows`), so a chain
of any height runs in the memory of some hundred rows; NaN marks missing pixels (`fill` bridges them for the filter).
"""
