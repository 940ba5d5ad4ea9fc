"""What is read from disk and written to it, whole files or none.

- `images`: pixels of TIFF, PNG and JPEG files, and which value is full scale; `tiff`: untrusted
  TIFF pages;
- `files`: outputs that are written whole, and never over an input;
- `tensors`: weights as safetensors.
"""
