"""The only reader and writer of images, on GDAL through rasterio.

facts        properties of an image before its pixels are read: `Raster`, `Georeference`
source       an image as a source of rows: `Source`, `ArraySource`
index        indexes of tiles (VRT, DIMAP), checked before GDAL follows them
description  the properties that GDAL states of an open image
reader       `open_raster`: any file by rows
images       whole images, and the images of a folder
full_scale   which pixel value is full scale
writer       TIFFs, and Cloud-Optimised GeoTIFFs
"""
