"""Methods compared on the same pairs and targets: scores with intervals, by image and by site, sweeps."""
