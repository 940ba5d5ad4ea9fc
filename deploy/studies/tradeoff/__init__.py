"""Compare accuracy with time: operating points measured on the same images, and a
recommendation.
"""
