"""Reports: one self-contained HTML file, pictures embedded, every number with its mode."""
