"""STAC items of a run: `item` describes the image and how it was made, `network` what made it."""
