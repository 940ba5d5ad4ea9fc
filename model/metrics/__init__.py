"""Image quality: how close to the reference (`fidelity`)."""
