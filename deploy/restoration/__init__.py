"""Restoration of images of any size: exact seams, little memory, resumable.

`model.raster` reads an image by rows. It passes, in this order:

    options      what a user can choose
    bands        a sensor, and so a network, for each band
    plan         how it is cut into tiles, and the memory that takes
    radiometry   which pixel value is full scale, and who says so
    runtime      the network, on onnxruntime or OpenVINO, here or by the workers of a Dask scheduler
    steps        the steps around the network: its exposures, and the consistency step
    tiles        the one tile loop, for files, arrays and Dask
    method       a network as a method that studies compare
    sensor_check what the image shows of its sensor, and whether it is raw at all
    detectors    what it shows of faulty detectors; a list of them, whose pixels are replaced
    journal      which rows are finished, and their digests
    checkpoint   the finished rows on the disk, which a later run can go on with
    output       from the finished rows to the TIFF, plain or cloud-optimised
    stac         the STAC item of a cloud-optimised output
    run          all of this for one file: `restore_file`
    traditional  a file by the traditional pipeline: `restore_file_traditionally`

`deploy.library.restore` is the same for notebooks. Nothing is imported here, so that `--help` stays
quick; none of these but `traditional` loads torch.
"""
