"""What is read from disk and written to it: images, TIFF pages, weights; whole files or none."""
