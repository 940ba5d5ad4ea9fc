"""A model of the DPUCVDX8G: what it can run, where each node goes, how long it takes, and at what
power.

- `board`: a configuration with its constants; `graph`: a network as the DPU sees it;
- `reading`: an ONNX file becomes such a graph;
- `checker`: rules and placement; `cost`: time and power.
"""
