"""The DPUCVDX8G from the outside: what it can run, where each node goes, how long it takes, at what power."""
