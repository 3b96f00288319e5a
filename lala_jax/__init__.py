"""Goal-conditioned pick-and-place from images and depth, in JAX, for a simulated UR5e.

Import the modules you need; this file imports none.
"""
