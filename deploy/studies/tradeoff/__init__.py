"""What accuracy costs in time: operating points measured on the same images, and which of them to
take.
"""
