"""Restorations judged on pairs: every method sees the same degraded images, the degraded input is a method too."""
