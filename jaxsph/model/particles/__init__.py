"""Particles: arrays of them, their kernels, their periods, and the amounts that they hold."""
