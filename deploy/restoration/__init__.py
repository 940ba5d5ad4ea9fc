"""Restoration of images of any size: exact seams, little memory, resumable.

`model.raster` reads an image by rows. It passes, in this order:

    bands        a sensor, and so a network, for each band
    plan         how it is cut into tiles; memory: the memory that this needs
    radiometry   how its pixels are interpreted: the full scale, and its origin
    detectors    faults of detectors; a list of them, whose pixels are replaced
    sensor_check the comparison with its sensor, and whether it is raw at all
    runtime      the network, on onnxruntime or OpenVINO, here or by the workers of a `cluster`
    steps        the steps around the network: its exposures, and the consistency step
    prepare      all of these made ready: `NetworkPipeline`
    traditional  the same for the traditional pipeline: `TraditionalMethod`
    tiles        the one tile loop, for files, arrays and Dask
    outcome      a comparison of the result with the image
    checkpoint   the finished rows on the disk and their journal, from which a later run continues
    output       from the finished rows to the TIFF, plain or cloud-optimised
    interval     the half-widths of the result, from its finished rows
    stac         the STAC items of a cloud-optimised output and of its networks
    run          all of this for one file: `restore_file`
    arrays       all of this for an array in memory: `restore_array`
    method       a network as a method that studies compare

`verbs.restore` calls `run` and `arrays`. Nothing is imported here, so that `--help` stays quick;
none of these but `traditional` loads torch.
"""
